"""Adaptive designs: the next settings follow from the numbers of those before.

Three samplers: `tpe` (Optuna's), `cma` (the CMA-ES of the library that Optuna uses) and `gp` (the
Gaussian process of `failure`). A round of `Sweep.batch` settings is asked for when the last one has
ended. What a sampler answers depends on the seed and on the settings and scores in the folder, and
on nothing else: after a kill the same round is asked for again.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.definition import Sweep
from snn_fusion_failure.sweeps.designs import digest, shares

Row = tuple[Any, ...]


def check_adaptive(sweep: Sweep) -> None:
    """Refuse a sampler that is not installed, or axes that it cannot draw.

    Raises:
        ValueError: names the axis or the extra.
    """
    kind, axes = sweep.design.kind, sweep.design.axes
    if sweep.batch < 1:
        raise ValueError(f"batch={sweep.batch}: expected at least one setting a round")
    needed = {"tpe": "optuna", "cma": "cmaes"}.get(kind)
    if needed is not None:
        import importlib.util

        if importlib.util.find_spec(needed) is None:
            raise ValueError(
                f"design={kind!r}: expected the library {needed}; "
                "pip install 'snn-fusion-failure[sweeps]'"
            )
    if kind == "cma":
        listed = [axis.leaf for axis in axes if axis.values]
        if listed or len(axes) < 2:
            raise ValueError(
                f"design='cma': expected two or more ranges; got {', '.join(listed) or len(axes)}; "
                "'tpe' and 'gp' take lists and single axes"
            )
        if sweep.batch < 3 or sweep.design.samples % sweep.batch:
            raise ValueError(
                f"samples={sweep.design.samples} batch={sweep.batch}: expected whole generations "
                "of at least 3; samples a multiple of batch"
            )


def ask(sweep: Sweep, rows: Sequence[Row], scores: np.ndarray, count: int) -> list[Row]:
    """The next settings.

    Args:
        sweep: its design names the sampler, the axes and the seed.
        rows: all settings so far, in order.
        scores: of each, larger is better; minus infinity for one that is not ranked.
        count: how many to return; fewer come when no others are left.
    """
    kind, axes = sweep.design.kind, sweep.design.axes
    sampler = {"tpe": _tpe, "cma": _cma, "gp": _gp}[kind]
    start = max(sweep.batch, 2 * len(axes) + 2)
    fresh = _Fresh(sweep.leaves, rows)
    if kind != "cma" and len(rows) < start:
        points = shares("sobol", len(axes), start, sweep.design.seed)
        for row in rows_at(axes, points[len(rows) :]):
            fresh.add(row)
        return fresh.rows[:count]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental features of the libraries
        for row in sampler(sweep, rows, scores, count):
            fresh.add(row)
    if kind == "cma":
        return fresh.rows[:count]
    # A sampler of few labels repeats itself: fill up with points that were never visited.
    extra = shares("random", len(axes), 64 * count, sweep.design.seed + len(rows))
    for row in rows_at(axes, extra):
        if len(fresh.rows) >= count:
            break
        fresh.add(row)
    return fresh.rows[:count]


class _Fresh:
    """Settings that were not there yet."""

    def __init__(self, leaves: Sequence[str], rows: Sequence[Row]) -> None:
        self.rows: list[Row] = []
        self._leaves = leaves
        self._known = {digest(leaves, row) for row in rows}

    def add(self, row: Row) -> None:
        words = digest(self._leaves, row)
        if words not in self._known:
            self._known.add(words)
            self.rows.append(row)


def rows_at(axes: Sequence[Axis], points: np.ndarray) -> list[Row]:
    """Settings at points of the unit cube; 12 digits, so that they can be typed."""
    columns = []
    for i, axis in enumerate(axes):
        values = axis.at(points[:, i])
        if axis.kind == "float" and not axis.values:
            values = [float(f"{v:.12g}") for v in values]
        columns.append(values)
    return list(zip(*columns, strict=True))


def _floor(scores: np.ndarray) -> np.ndarray:
    """Scores with those that are none below all others."""
    finite = scores[np.isfinite(scores)]
    if len(finite) == 0:
        return np.zeros_like(scores)
    return np.where(np.isfinite(scores), scores, finite.min() - (np.ptp(finite) or 1.0))


def _tpe(sweep: Sweep, rows: Sequence[Row], scores: np.ndarray, count: int) -> list[Row]:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    axes = sweep.design.axes
    space: dict[str, Any] = {}
    for axis in axes:
        if axis.values:
            space[axis.leaf] = optuna.distributions.CategoricalDistribution(axis.values)
        elif axis.kind == "int":
            space[axis.leaf] = optuna.distributions.IntDistribution(
                int(axis.low), int(axis.high), log=axis.log
            )
        else:
            space[axis.leaf] = optuna.distributions.FloatDistribution(
                axis.low, axis.high, log=axis.log
            )
    sampler = optuna.samplers.TPESampler(
        seed=sweep.design.seed + 1_000_003 * len(rows), n_startup_trials=1, multivariate=True,
        constant_liar=True,
    )  # fmt: skip
    study = optuna.create_study(direction="maximize", sampler=sampler)
    for row, score in zip(rows, _floor(scores), strict=True):
        params = {
            a.leaf: v if a.values else min(max(v, a.low), a.high)
            for a, v in zip(axes, row, strict=True)
        }
        study.add_trial(
            optuna.trial.create_trial(params=params, distributions=space, value=float(score))
        )
    found = []
    for _ in range(2 * count):  # some may have been visited
        trial = study.ask(space)
        row = tuple(trial.params[axis.leaf] for axis in axes)
        found.append(
            tuple(float(f"{v:.12g}") if a.kind == "float" and not a.values else v
                  for a, v in zip(axes, row, strict=True))
        )  # fmt: skip
    return found


def _cma(sweep: Sweep, rows: Sequence[Row], scores: np.ndarray, count: int) -> list[Row]:
    """Generation after generation is drawn again from the seed and told what came of it."""
    import cmaes

    axes, size = sweep.design.axes, sweep.batch
    bounds = np.tile([0.0, 1.0 - 1e-12], (len(axes), 1))
    optimizer = cmaes.CMA(
        mean=np.full(len(axes), 0.5), sigma=0.25, bounds=bounds, seed=sweep.design.seed,
        population_size=size,
    )  # fmt: skip
    told = _floor(scores)
    for first in range(0, len(rows), size):
        points = [optimizer.ask() for _ in range(size)]
        optimizer.tell([(p, -float(s)) for p, s in zip(points, told[first:], strict=False)])
    return rows_at(axes, np.stack([optimizer.ask() for _ in range(count)]))


def _features(axes: Sequence[Axis], rows: Sequence[Row]) -> np.ndarray:
    """Settings as points: numbers by their share of the range, labels one by one."""
    columns: list[np.ndarray] = []
    for i, axis in enumerate(axes):
        if axis.kind in ("category", "static"):
            index = np.asarray([axis.values.index(row[i]) for row in rows])
            # Two labels are as far apart as the ends of a range.
            columns += [np.sqrt(0.5) * (index == k) for k in range(len(axis.values))]
        else:
            columns.append(np.asarray([axis.share_of(row[i]) for row in rows]))
    return np.stack(columns, 1) - 0.5


def _gp(sweep: Sweep, rows: Sequence[Row], scores: np.ndarray, count: int) -> list[Row]:
    """Expected improvement under the Gaussian process of `failure`, one setting after another.

    A setting that was just chosen counts as if its mean had been found, so that the next one is
    drawn elsewhere.
    """
    import jax
    import jax.numpy as jnp

    from failure.models import acquisition, gp, gp_fit

    axes = sweep.design.axes
    rng = np.random.default_rng((sweep.design.seed, len(rows)))
    wide = shares("sobol", len(axes), 512, sweep.design.seed + len(rows))
    best = np.argsort(-scores, kind="stable")[:4]
    centres = np.asarray([[a.share_of(v) for a, v in zip(axes, rows[i], strict=True)]
                          for i in best])  # fmt: skip
    near = centres[rng.integers(len(centres), size=512)] + 0.08 * rng.standard_normal(
        (512, len(axes))
    )
    pool = rows_at(axes, np.concatenate([wide, np.clip(near, 0.0, 1.0 - 1e-12)]))
    pool = list(dict.fromkeys(pool))
    config = gp.GPConfig()
    size = gp.padded_size(len(rows) + count)
    with jax.enable_x64(True):
        candidates = jnp.asarray(_features(axes, pool))
        x = np.zeros((size, candidates.shape[1]))
        y = np.zeros(size)
        x[: len(rows)], y[: len(rows)] = _features(axes, rows), _floor(scores)
        used = (np.arange(size) < len(rows)).astype(float)
        z, _, _ = gp.standardize(jnp.asarray(y), jnp.asarray(used))
        n = jnp.asarray(len(rows))
        start = gp_fit.initial_params(config, x.shape[1])
        fitted = gp_fit.fit(config, start, jnp.asarray(x), z, n).params
        outputs = np.asarray(z).copy()
        top = outputs[: len(rows)].max()
        found: list[Row] = []
        for place in range(len(rows), len(rows) + count):
            posterior = gp.condition(
                config, fitted, jnp.asarray(x), jnp.asarray(outputs), jnp.asarray(place)
            )
            mean, variance = gp.predict(config, posterior, candidates)
            value = acquisition.log_ei(mean, jnp.sqrt(variance), jnp.asarray(top))
            chosen = int(jnp.argmax(value))
            found.append(pool[chosen])
            x[place], outputs[place] = np.asarray(candidates[chosen]), float(mean[chosen])
    return found
