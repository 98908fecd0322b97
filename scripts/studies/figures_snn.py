"""Figures of the spiking robots: 2.2, 2.3, 2.9 to 2.14, a spike raster and an animated trial.

    python scripts/studies/figures_snn.py

Trains S4 once per scenario (seed 0, as in the tables of record) and draws what it did. Learning
curves come from the runs of record under `runs/train_snn`, where they are. Writes
`docs/images/snn_*.png` and `snn_trial.gif`. About two CPU-minutes.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import enable_compilation_cache, progress, run_command

PHASES = {"learning": 0, "testing": 1}


@dataclasses.dataclass(frozen=True)
class Figures:
    """What to draw."""

    model: str = "S4"
    reading: str = "tuned"
    seed: int = 0
    scenarios: tuple[int, ...] = (1, 2, 3)
    runs: Path = Path("runs/train_snn")
    """Runs of record, for the learning curves."""
    out: Path = Path("docs/images")


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def draw_rules(config: Figures) -> None:
    """Weight change of one pair of spikes: STDP (2.2), and with rewards (2.3)."""
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import plasticity, plots

    lag = np.linspace(-100.0, 100.0, 401)
    seconds = jnp.asarray(lag * 1e-3, jnp.float32)
    params = plasticity.STDPParams()
    save(
        plots.plot_stdp_curve(lag, np.asarray(plasticity.stdp_curve(params, seconds))),
        config.out / "snn_stdp.png",
    )
    rewards = (2.0, 1.0, -1.0, -2.0)
    changes = plasticity.rm_stdp_curve(params, seconds, jnp.asarray(rewards))
    named = {f"reward {r:+g}": np.asarray(c) for r, c in zip(rewards, changes, strict=True)}
    save(plots.plot_rm_stdp_curves(lag, named), config.out / "snn_rm_stdp.png")


def draw_trajectories(config: Figures, scenario: int) -> Any:
    """Trials of both phases of one robot (2.9 to 2.14); returns the experiment."""
    import numpy as np

    from jaxsnn import plots, scenarios
    from jaxsnn.experiment import TEST_TRIALS, learning_circles, make_runner
    from jaxsnn.presets import preset
    from jaxsnn.status import Status

    built, params = preset(config.model, config.reading)
    map = scenarios.scenario(scenario)
    run = make_runner(
        built, map, n_learn=20, n_test=TEST_TRIALS[scenario], block=1,
        circles=learning_circles(scenario, 20), record=True, keep_states=True,
    )  # fmt: skip
    experiment = run([config.seed], params)
    for name, index in PHASES.items():
        phase = experiment[index]
        assert phase is not None and phase.poses is not None, "asked for: record=True"
        poses = np.asarray(phase.poses)
        steps, status = phase.steps[0], phase.status[0]
        figure = plots.plot_trajectories(
            map,
            [poses[0, i, : n + 1, :2] for i, n in enumerate(steps)],
            arrived=[bool(s == Status.ARRIVED) for s in status],
            collided=[bool(s == Status.COLLIDED) for s in status],
            title=f"{config.model}, Scenario {scenario}, {name}",
        )
        save(figure, config.out / f"snn_scenario{scenario}_{name}.png")
    return experiment


def draw_trial(config: Figures, scenario: int, experiment: Any) -> None:
    """The last testing trial as an animation, and the spikes of its first control step."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from matplotlib.animation import PillowWriter

    from jaxsnn import network, plots, scenarios, world
    from jaxsnn.config import neuron_signs
    from jaxsnn.encoding import group_rates, poisson_spikes
    from jaxsnn.presets import preset
    from jaxsnn.status import Status

    map = scenarios.scenario(scenario)
    phase = experiment.testing
    trial = phase.steps.shape[1] - 1
    poses = phase.poses[0, trial, : phase.steps[0, trial] + 1]

    def look(pose: Any) -> Any:
        t, key = jnp.zeros((), jnp.int32), jax.random.key(0)
        return world.observe(map, world.WorldState(pose[0], pose[1], pose[2], t, key))

    readings = jax.jit(jax.vmap(look))(jnp.asarray(poses))
    movie = plots.plot_trial(
        map, poses[:, :2], poses[:, 2], sonar=np.asarray(readings.sonar),
        arrived=bool(phase.status[0, trial] == Status.ARRIVED),
        collided=bool(phase.status[0, trial] == Status.COLLIDED),
        title=f"{config.model}, Scenario {scenario}, after 20 trials",
    )  # fmt: skip
    movie.save(config.out / "snn_trial.gif", writer=PillowWriter(fps=12), dpi=90)

    built, params = preset(config.model, config.reading)
    state = jax.tree.map(lambda x: jnp.asarray(x[0]), experiment.states)
    first = jax.tree.map(lambda x: x[0], readings)
    rates = group_rates(built.rates, first.sonar, first.distance, first.angle)
    rates = jnp.repeat(rates, built.group_exc + built.group_inh)
    pre = poisson_spikes(rates, built.control_steps, key=jax.random.key(1), dt=built.dt)
    _, spikes = jax.jit(network.fire, static_argnums=0)(built, params, state, pre)
    sign_in, sign_hidden = neuron_signs(built)
    layers = {"input": pre, "hidden": spikes.hidden, "motors": spikes.output}
    weights = {
        "input to hidden": np.asarray(state.weights.hidden) * sign_in[:, None],
        "hidden to motors": (np.asarray(state.weights.output).ravel() * sign_hidden)
        .reshape(2, -1)
        .T,
    }
    figure = plots.plot_spike_raster(
        {name: np.asarray(s, bool) for name, s in layers.items()}, weights, dt=1e3 * built.dt
    )
    save(figure, config.out / "snn_raster.png")


def draw_curves(config: Figures, scenario: int) -> bool:
    """Success of each learning trial, mean over the seeds of record; False without runs."""
    import numpy as np

    from jaxsnn import plots
    from jaxsnn.status import Status

    curves = {}
    for network in ("S1", "S2", "S3", "S4"):
        folder = config.runs / f"scenario{scenario}_{network}_{config.reading}" / "seeds"
        records = [r for f in sorted(folder.glob("*.json")) for r in json.loads(f.read_text())]
        if records:
            status = np.array([r["learning"]["status"] for r in records])
            curves[f"{network} ({len(records)} robots)"] = (status == Status.ARRIVED).astype(float)
    if curves:
        figure = plots.plot_learning_curves(curves, window=3)
        save(figure, config.out / f"snn_learning_scenario{scenario}.png")
    return bool(curves)


def main(config: Figures) -> dict[str, Any]:
    """Draw everything; returns which scenarios had runs of record."""
    enable_compilation_cache()
    draw_rules(config)
    curves = {}
    with progress() as bar:
        task = bar.add_task("figures", total=len(config.scenarios), status="")
        for scenario in config.scenarios:
            bar.update(task, status=f"Scenario {scenario}")
            experiment = draw_trajectories(config, scenario)
            if scenario == config.scenarios[-1]:
                draw_trial(config, scenario, experiment)
            curves[scenario] = draw_curves(config, scenario)
            bar.advance(task)
    return {"out": str(config.out), "curves": curves}


def fields(found: dict[str, Any]) -> dict[str, Any]:
    """What the result line says."""
    return {"out": found["out"], "learning_curves": sum(found["curves"].values())}


if __name__ == "__main__":
    run_command(Figures, main, description=__doc__, fields=fields)
