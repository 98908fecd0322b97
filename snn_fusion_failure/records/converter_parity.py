"""Agreement of the DC-DC converter with ngspice: parts of `scripts/studies/study_parity.py`."""

from __future__ import annotations

from typing import Any, Protocol


class Sizes(Protocol):
    """What the parts read of the study's options."""

    @property
    def dcdc_samples(self) -> int:
        """Normal samples."""

    @property
    def far_dcdc_samples(self) -> int:
        """Samples along each slope, and at each other load."""

    @property
    def grid_samples(self) -> int:
        """Samples of the comparison of grids."""

    @property
    def max_step(self) -> float:
        """Largest time step of ngspice [s]."""

    @property
    def workers(self) -> int:
        """ngspice processes at a time."""

    @property
    def seed(self) -> int:
        """Of the samples."""


def ranks(a: Any, b: Any, names: tuple[str, ...]) -> dict[str, float]:
    """Spearman correlation of every column."""
    from scipy.stats import spearmanr

    return {n: float(spearmanr(a[:, k], b[:, k]).statistic) for k, n in enumerate(names)}


def spread(difference: Any, values: Any, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Of every column: largest, mean and standard deviation of a difference; spread of values."""
    import numpy as np

    found = {}
    for k, name in enumerate(names):
        move, sd = difference[:, k], float(np.std(values[:, k]))
        found[name] = {
            "max": float(np.abs(move).max()),
            "median": float(np.median(np.abs(move))),
            "mean": float(move.mean()),
            "sd": float(move.std()),
            "spread": sd,
            "max_share": float(np.abs(move).max()) / sd,
            "sd_share": float(move.std()) / sd,
        }
    return found


def dcdc_ngspice(config: Sizes) -> dict[str, Any]:
    """DC-DC converter against every transistor switching in every period."""
    import numpy as np

    from failure.circuits.buck.circuit import make_dcdc

    x = np.random.default_rng(config.seed).normal(size=(config.dcdc_samples, 44))
    result: dict[str, Any] = {"samples": len(x), "max_step": config.max_step}
    circuit = make_dcdc("level1")
    ours, status = (np.asarray(a) for a in circuit.simulate(x))
    names = circuit.spec_names
    theirs, failed = circuit.reference(x, max_step=config.max_step, workers=config.workers)
    coarse, failed_too = circuit.reference(
        x, max_step=2.0 * config.max_step, workers=config.workers
    )
    good = (status == 0) & (failed == 0) & (failed_too == 0)
    result["compared"] = int(good.sum())
    result["rank_correlation"] = ranks(ours[good], theirs[good], names)
    result["difference"] = spread((ours - theirs)[good], theirs[good], names)
    result["ngspice_with_twice_the_step"] = {
        "rank_correlation": ranks(coarse[good], theirs[good], names),
        "difference": spread((coarse - theirs)[good], theirs[good], names),
    }
    return result


def dcdc_grid(config: Sizes) -> dict[str, Any]:
    """DC-DC specifications on the shipped grid and with steps ten times shorter."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.circuits.buck import converter

    x = np.random.default_rng(config.seed + 1).normal(size=(44, config.grid_samples))
    result: dict[str, Any] = {"samples": config.grid_samples}
    names = tuple(s.name for s in converter.SPECS)
    with jax.enable_x64(True):

        def solved(refine: int) -> Any:
            run = jax.jit(lambda u: converter.solve_dcdc(u, refine=refine, points=8)[0])
            return np.asarray(run(jnp.asarray(x))).T

        fine = solved(10)
        for refine in (1, 2, 4):
            values = solved(refine)
            result[f"steps_divided_by_{refine}"] = {
                "difference": spread(values - fine, fine, names),
                "rank_correlation": ranks(values, fine, names),
            }
    return result


def far_points(values: Any, n: int, seed: int) -> Any:
    """Normal samples moved to -6 to 6 sigma along the slope of each column of `values`.

    Args:
        values: `x [m, 44] -> specs [m, k]`.
        n: samples of each column.
        seed: of the samples.
    Returns:
        `[k n, 44]`.
    """
    import numpy as np

    step = 0.1 * np.eye(44)
    moved = np.asarray(values(np.concatenate([step, -step])))
    up, down = np.split(moved, 2)
    axes = (up - down) / np.linalg.norm(up - down, axis=0)
    rng = np.random.default_rng(seed)
    found = []
    for axis in axes.T:
        x = rng.normal(size=(n, 44))
        reach = np.linspace(-6.0, 6.0, n)
        found.append(x + (reach - x @ axis)[:, None] * axis)
    return np.concatenate(found)


def against(ours: Any, theirs: Any, failed: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Differences and ranks of the samples that ngspice has simulated."""
    good = failed == 0
    return {
        "compared": int(good.sum()),
        "ngspice_failed": int((~good).sum()),
        "difference": spread((ours - theirs)[good], theirs[good], names),
        "rank_correlation": ranks(ours[good], theirs[good], names),
    }


def dcdc_far(config: Sizes) -> dict[str, Any]:
    """DC-DC converter at 6 sigma and at other loads against all transistors switching."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.circuits.buck import converter, schematic
    from failure.circuits.buck.reference import dcdc_reference

    names = tuple(s.name for s in converter.SPECS)
    usual = (schematic.LOAD_HEAVY, schematic.LOAD_LIGHT)
    with jax.enable_x64(True):
        program = jax.jit(
            lambda u, loads: converter.solve_dcdc(u, model="level1", loads=(loads[0], loads[1]))[0]
        )

        def ours(x: Any, loads: tuple[float, float]) -> Any:
            return np.asarray(program(jnp.asarray(x.T), jnp.asarray(loads))).T

        far = far_points(lambda x: ours(x, usual), config.far_dcdc_samples, config.seed + 4)
        near = np.random.default_rng(config.seed + 5).normal(size=(config.far_dcdc_samples, 44))
        result: dict[str, Any] = {"max_step": config.max_step}
        cases = {"6_sigma": (far, usual)}
        cases |= {f"{a:g}_to_{b:g}_A": (near, (a, b)) for a, b in ((0.4, 0.2), (0.12, 0.3))}
        for name, (x, loads) in cases.items():
            theirs, failed = dcdc_reference(
                x, max_step=config.max_step, workers=config.workers, loads=loads
            )
            result[name] = against(ours(x, loads), theirs, failed, names)
    return result


def light_ngspice(config: Sizes) -> dict[str, Any]:
    """The converter at light load, at 6 sigma and at other loads against transistors switching."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.circuits.buck import light_load
    from failure.circuits.buck.light_reference import light_reference

    names = tuple(s.name for s in light_load.SPECS)
    with jax.enable_x64(True):
        program = jax.jit(
            lambda u, load: light_load.solve_dcdc_light(u, model="level1", load=load)[0]
        )

        def ours(x: Any, load: float) -> Any:
            return np.asarray(program(jnp.asarray(x.T), jnp.asarray(load))).T

        far = far_points(
            lambda x: ours(x, light_load.LOAD), config.far_dcdc_samples, config.seed + 6
        )
        near = np.random.default_rng(config.seed + 7).normal(size=(config.far_dcdc_samples, 44))
        result: dict[str, Any] = {"max_step": config.max_step}
        cases = {"6_sigma": (far, light_load.LOAD)}
        cases |= {f"{1e3 * load:g}_mA": (near, load) for load in (light_load.LOAD, 5e-3, 30e-3)}
        for name, (x, load) in cases.items():
            theirs, failed = light_reference(
                x, max_step=config.max_step, workers=config.workers, load=load
            )
            result[name] = against(ours(x, load), theirs, failed, names)
    return result
