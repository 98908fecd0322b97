"""Options of `train_snn`; its seeds, run in chunks, drawn, kept and gone on with."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from snn_fusion_failure.runs import progress, write_json
from snn_fusion_failure.runs.networks import changed_preset

N_LEARN = 20
Reading = Literal["tuned", "literal", "guided", "way", "critic"]


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and test a spiking network."""

    scenario: Literal[1, 2, 3] = 1
    """Map of the source."""
    map: str | None = None
    """Another map: a JSON file, D1 to D3, or FAMILY/SPLIT/NUMBER such as detour/train/0."""
    model: Annotated[Literal["S1", "S2", "S3", "S4"], arg(aliases=["--network"])] = "S4"
    """Network and learning rule (Table 2.2 of the source)."""
    reading: Annotated[Reading, arg(aliases=["--setting"])] = "tuned"
    """Readings and options, see docs/snn_networks.md."""
    seeds: int = 64
    """Independent runs."""
    first_seed: int = 0
    """Number of the first of them."""
    preset: Literal["paper", "quick"] = "paper"
    """quick: 4 seeds, 10 testing trials."""
    learn_trials: int = N_LEARN
    """Trials of the learning phase."""
    save: Path | None = None
    """Keep the trained networks in this .npz file; all seeds are run for it."""
    source: Annotated[Path | None, arg(name="from")] = None
    """Go on with the networks of this file instead of new ones."""
    online_trials: int = 0
    """Further testing trials with plasticity left on."""
    max_steps: int = 200
    """Control steps after which a trial is given up."""
    block: int = 8
    """Robots per block; 4 to 8 on a CPU, all on an accelerator."""
    chunk: int = 16
    """Seeds per file and per call of the compiled program."""
    changes: Annotated[tuple[str, ...], arg(name="set", aliases=["--changes"])] = ()
    """Changed constants as part.name=value: `params.gamma=5e-4 config.bounds=soft`."""
    out: Path | None = None
    """Run folder; default runs/train_snn/SCENARIO_MODEL_READING."""
    resume: bool = False
    """Go on with the run in OUT."""
    overwrite: bool = False
    """Forget the run in OUT."""
    record: bool = False
    """Write the rows of the source's table into results/."""
    figures: bool = True
    """Draw trajectories and the learning curve."""


def run_seeds(
    config: Config, out: Path, map: Any, n_seeds: int, n_test: int
) -> tuple[list[dict[str, Any]], Any]:
    """The records of all seeds, those in `out` read back; and the first experiment that was run."""
    import jax

    from jaxsnn import scores
    from jaxsnn.experiment import learning_circles, make_runner
    from jaxsnn.ways import training_map

    network, params = changed_preset(config.model, config.reading, config.changes)
    circles = None
    if config.map is None and network.starts == "circles":
        circles = learning_circles(config.scenario, config.learn_trials)
    run = make_runner(
        network, training_map(network, map), n_learn=config.learn_trials, n_test=n_test,
        test_map=map,
        n_online=config.online_trials, max_steps=config.max_steps, block=config.block,
        circles=circles, record=config.figures, keep_states=config.save is not None,
    )  # fmt: skip
    states = first_networks(config, network, params, n_seeds)
    last = config.first_seed + n_seeds
    trained: list[Any] = []
    records, shown = [], None
    with progress() as bar:
        task = bar.add_task("seeds", total=n_seeds, status="")
        for start in range(config.first_seed, last, config.chunk):
            numbers = list(range(start, min(start + config.chunk, last)))
            file = out / "seeds" / f"{start:05d}_{len(numbers)}.json"
            if file.exists() and config.save is None:
                records += json.loads(file.read_text(encoding="utf-8"))
            else:
                rows = slice(start - config.first_seed, start - config.first_seed + len(numbers))
                own = None if states is None else jax.tree.map(lambda x, r=rows: x[r], states)
                experiment = run(numbers, params, None, own)
                trained.append(experiment.states)
                chunk = scores.per_seed(experiment, numbers)
                write_json(file, chunk)
                records += chunk
                shown = shown or experiment._replace(states=None)
            rate = sum(scores.success(r, "testing") for r in records) / len(records)
            bar.update(task, advance=len(numbers), status=f"SR-testing {rate:.0f} %")
    if config.save is not None:
        import numpy as np

        from jaxsnn.saved import save_networks

        save_networks(config.save, network, jax.tree.map(lambda *x: np.concatenate(x), *trained))
    return records, shown


def first_networks(config: Config, network: Any, params: Any, n_seeds: int) -> Any:
    """The networks of `--from`, one for each seed; None without it."""
    import jax

    from jaxsnn.saved import load_networks

    if config.source is None:
        return None
    states = load_networks(config.source, network, params)
    if len(states.updates) < n_seeds:
        raise ValueError(
            f"seeds={n_seeds}: expected at most the {len(states.updates)} networks of "
            f"{config.source}; lower it"
        )
    return jax.tree.map(lambda x: x[:n_seeds], states)


def draw(out: Path, config: Config, map: Any, experiment: Any, records: list[Any]) -> None:
    """Trajectories of the first seed in both phases and the learning curve over all seeds."""
    import numpy as np

    from jaxsnn import plots
    from jaxsnn.status import Status

    for name in ("learning", "testing"):
        phase = getattr(experiment, name)
        steps, status = phase.steps[0], phase.status[0]
        figure = plots.plot_trajectories(
            map,
            [phase.poses[0, i, : n + 1, :2] for i, n in enumerate(steps)],
            arrived=[bool(s == Status.ARRIVED) for s in status],
            collided=[bool(s == Status.COLLIDED) for s in status],
            title=f"{config.model}, {name_of(config)}, {name} phase",
        )
        figure.savefig(out / f"trajectories_{name}.png", dpi=120)
    curve = np.array([r["learning"]["status"] for r in records]) == Status.ARRIVED
    figure = plots.plot_learning_curves({config.model: curve.astype(float)}, window=3)
    figure.savefig(out / "learning_curve.png", dpi=120)


def name_of(config: Config) -> str:
    """Name of the map, as titles and folders have it."""
    if config.map is None:
        return f"Scenario {config.scenario}"
    return Path(config.map).stem if config.map.endswith(".json") else config.map.replace("/", " ")
