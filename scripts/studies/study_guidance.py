"""Choose the constants of the graded reward: by the rule itself, on validation maps alone.

    python scripts/studies/study_guidance.py

The rule of `jaxsnn.turn_goal` drives by itself (`jaxsnn.guidance`): what a network that learns
from the reward could do at most. Constants are drawn at random from values at the borders of the
interval code, so that the network can see what the rule sees; the best mean success over maps of
the validation splits of all families is chosen. It is then tested once on Scenario 1 to 3, D1 to
D3 and the test split of the detour family, beside the constants from before. Writes
`results/study_guidance.json` with the chosen constants. About five CPU-minutes.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, progress, repository, run_command
from snn_fusion_failure.runs.origin import check_recordable

GRID: dict[str, tuple[float, ...]] = {
    "side": (30.0, 60.0, 120.0, 180.0),
    "diagonal": (60.0, 120.0, 180.0),
    "front": (60.0, 120.0, 180.0, 240.0),
    "blocked": (0.0, 60.0, 120.0, 180.0),
    "avoid": (20.0, 30.0, 45.0, 60.0),
    "towards": (30.0, 45.0, 60.0),
    "commitment": (0.5, 1.0, 2.0, 4.0, 8.0),
    "memory": (0.5, 0.7, 0.9, 0.97),
}
"""Values of each constant; distances at borders of the intervals of 60 px [px, deg]."""
FAMILIES = ("open", "cluttered", "detour", "maze")
TESTS = ("S1", "S2", "S3", "D1", "D2", "D3")
TITLE = "The rule behind the graded reward, driving by itself"


@dataclasses.dataclass(frozen=True)
class Config:
    """Choose constants of the graded reward."""

    samples: int = 1024
    """Random sets of constants."""
    maps: int = 3
    """Validation maps of each family."""
    test_maps: int = 20
    """Maps of the test split of the detour family."""
    robots: int = 8
    trials: int = 2
    """Of each robot on each map of the choice; ten on the test maps of one name."""
    max_steps: int = 200
    seed: int = 0


def draw(config: Config) -> Any:
    """Random constants, leaves `[samples]`; the first set is the one from before."""
    import numpy as np

    from jaxsnn.turn_goal import TurnGoalParams

    rng = np.random.default_rng(config.seed)
    n = config.samples
    drawn: dict[str, Any] = {k: rng.choice(v, n).astype(np.float32) for k, v in GRID.items()}
    before = TurnGoalParams()._asdict()
    for name, values in drawn.items():
        values[0] = before[name]
    held: Any = {k: np.full(n, v, np.float32) for k, v in before.items() if k not in drawn}
    return TurnGoalParams(**drawn, **held)


def success(config: Config, params: Any, map: Any, trials: int) -> Any:
    """Success of each robot on a map for each set of constants, `[samples, robots]`, in percent."""
    import jax
    import numpy as np

    from jaxsnn.experiment import phase_keys, seed_keys
    from jaxsnn.guidance import drive_guided
    from jaxsnn.trials import success_rate

    keys = jax.vmap(lambda k: phase_keys(k)[2])(seed_keys(range(config.robots)))

    def one(p: Any) -> Any:
        return success_rate(
            drive_guided(p, map, keys=keys, n_trials=trials, max_steps=config.max_steps)
        )

    return 100.0 * np.asarray(jax.vmap(one)(params))


def main(config: Config) -> dict[str, Any]:
    """Choose on validation maps, then test once."""
    import jax
    import numpy as np

    from jaxsnn import families
    from jaxsnn.map_files import named_map

    check_recordable()
    enable_compilation_cache()
    params = draw(config)
    scores = []
    with progress() as bar:
        task = bar.add_task("validation maps", total=len(FAMILIES) * config.maps, status="")
        for family in FAMILIES:
            for number in range(config.maps):
                map = families.family_map(family, "validation", number)
                scores.append(success(config, params, map, config.trials).mean(axis=1))
                status = f"best so far {np.mean(scores, axis=0).max():.0f} %"
                bar.update(task, advance=1, status=status)
    score = np.mean(scores, axis=0)
    best = int(np.argmax(score))
    chosen = {name: float(getattr(params, name)[best]) for name in GRID}
    two = jax.tree.map(lambda v: v[np.array([0, best])], params)
    tests = {name: success(config, two, named_map(name), 10) for name in TESTS}
    unseen = [families.family_map("detour", "test", i) for i in range(config.test_maps)]
    tests["held-out detour family"] = np.mean([success(config, two, m, 1) for m in unseen], axis=0)
    tests["validation families"] = np.array(scores).T[np.array([0, best])]
    rows = [
        {"row": row, "model": model, "metric": "sr_testing", "unit": "%", **summarize(v.tolist())}
        for row, values in tests.items()
        for model, v in zip(("before", "chosen"), values, strict=True)
    ]
    for row in rows:
        if row["model"] == "chosen":
            row["constants"] = chosen
    path = repository.RESULTS / "study_guidance.json"
    record_table(path, path.stem, TITLE, rows, preset=f"{config.samples} sets of constants")
    return chosen | {"validation": float(score[best]), "before": float(score[0])}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
