"""A user's function of one trial as a study: batched, its metrics found by tracing it once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.study import Metric, Study

Trial = Callable[[Any, Any], Mapping[str, Any]]


def name_of(trial: Trial) -> str:
    """Where another process finds the function: `module:name`, or `file.py:name` of a script."""
    import sys

    name = getattr(trial, "__qualname__", type(trial).__name__)
    module = getattr(trial, "__module__", "")
    if module == "__main__":
        file = getattr(sys.modules["__main__"], "__file__", None)
        return f"{file}:{name}" if file else f"__main__:{name}"
    return f"{module}:{name}"


def from_trial(
    trial: Trial,
    axes: Sequence[Axis],
    *,
    name: str | None = None,
    metrics: Mapping[str, Metric] | None = None,
    objective: str | None = None,
    goals: Mapping[str, str] | None = None,
    static: Mapping[str, Any] | None = None,
) -> Study:
    """A study of `trial(params, key) -> {metric: scalar}`.

    Args:
        trial: jittable, of one trial; `params` is a dict with the value of every axis.
        axes: what is swept.
        name: where another process finds the function.
        metrics: unit, text and goal of metrics; those left out have none.
        objective: the metric to rank by; the first that the trial returns when left out.
        goals: metric -> "max" or "min"; an objective without one is maximised.
        static: values of the static axes in this variant; the first of each when left out.

    Raises:
        ValueError: the trial cannot be traced, returns no dict of scalars, or lacks a metric that
            is named.
    """
    import jax
    import jax.numpy as jnp

    fixed = {axis.leaf: axis.values[0] for axis in axes if axis.kind == "static"}
    fixed |= dict(static or {})
    traced: dict[str, Any] = {
        axis.leaf: 0 if axis.kind in ("int", "category") else 0.0
        for axis in axes
        if axis.kind != "static"
    }
    order: list[str] = []

    def one(params: dict[str, Any], key: Any) -> dict[str, Any]:
        found = trial({**fixed, **params}, key)
        if not isinstance(found, Mapping):
            raise TypeError(f"it returned {type(found).__name__}, expected a dict of metrics")
        order[:] = [str(k) for k in found]
        return {str(k): jnp.asarray(v) for k, v in found.items()}

    def shapes() -> Any:
        values = {k: jnp.int32 if isinstance(v, int) else jnp.float32 for k, v in traced.items()}
        params = {k: jax.ShapeDtypeStruct((), kind) for k, kind in values.items()}
        return jax.eval_shape(one, params, jax.eval_shape(lambda: jax.random.key(0)))

    where = name or name_of(trial)
    try:
        found = shapes()
    except Exception as error:
        raise ValueError(
            f"study={where}: expected a function of (params, key) that jax can trace with params "
            f"{ {**fixed, **traced} }; {type(error).__name__}: {error}"
        ) from error
    odd = [f"{k}{list(v.shape)}" for k, v in found.items() if v.shape]
    if odd or not found:
        raise ValueError(
            f"study={where}: expected a dict of scalars; got {', '.join(odd) or 'no metric'}"
        )
    known = {k: (metrics or {}).get(k, Metric()) for k in order}
    chosen = objective or next(iter(goals or {}), None) or order[0]
    unknown = sorted({chosen, *(metrics or {}), *(goals or {})} - set(order))
    if unknown:
        raise ValueError(
            f"metric={', '.join(unknown)}: expected one of {', '.join(order)}, which the trial "
            "returns"
        )
    for metric in {chosen, *(goals or {})}:
        goal: Any = (goals or {}).get(metric) or known[metric].goal or "max"
        held = known[metric]
        known[metric] = Metric(held.unit, held.text, goal, held.optional)

    def variant(values: dict[str, Any]) -> Study:
        return from_trial(
            trial, axes, name=name, metrics=metrics, objective=objective, goals=goals, static=values
        )

    return Study(
        name=where,
        options={},
        params=traced,
        run=jax.vmap(one),
        metrics=known,
        objective=chosen,
        variant=variant,
        source=trial,
    )
