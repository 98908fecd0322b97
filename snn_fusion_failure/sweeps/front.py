"""`sweep`: run any jittable function of one trial over settings and seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import WorkFailedError, enable_compilation_cache
from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.engine import Layout, build, collect, describe, execute, open_sweep
from snn_fusion_failure.sweeps.study import Metric, Study, load_study
from snn_fusion_failure.sweeps.trial import Trial, from_trial
from snn_fusion_failure.sweeps.worker import brief


def axes_of(space: Mapping[str, Axis], study: Study | None = None) -> list[Axis]:
    """The axes of a space, named, with the units of a study.

    Raises:
        ValueError: a value is no axis, or the study has no such leaf.
    """
    axes = []
    for name, axis in space.items():
        if not isinstance(axis, Axis):
            raise ValueError(
                f"space[{name!r}]={axis!r}: expected grid(...), uniform(...), loguniform(...), "
                "integers(...), choice(...) or categorical(...)"
            )
        if study is None:
            axes.append(axis._replace(leaf=name))
            continue
        leaf, kind, _ = study.axis_of(name)
        if (kind == "static") != (axis.kind == "static"):
            wanted = "choice(...)" if kind == "static" else "numbers, not choice(...)"
            raise ValueError(f"space[{name!r}]: expected {wanted}")
        axes.append(axis._replace(leaf=leaf, unit=study.unit_of(leaf)))
    return axes


def sweep(
    trial: Callable[[Any, Any], Mapping[str, Any]] | Study | str,
    space: Mapping[str, Axis],
    *,
    seeds: int = 8,
    out: str | Path = "runs/sweep",
    samples: int = 0,
    design: str = "",
    objective: str | None = None,
    goal: str = "",
    metrics: Mapping[str, Metric] | None = None,
    root: int = 0,
    common_seeds: bool = False,
    workers: int = 1,
    chunk_size: str | int = "auto",
    chunk_trials: int = 0,
    overwrite: bool = False,
    retry_failed: bool = False,
    allow_mixed: bool = False,
    **choices: Any,
) -> Any:
    r"""Run a trial over settings and seeds, resumably, and return a labelled data set.

    A folder that holds part of the sweep is gone on with; asked for more seeds, samples or values
    it grows, and what is there is not computed again. Seed :math:`k` of a setting gets a key that
    follows from the setting's values and :math:`k` alone.

    Args:
        trial: `(params, key) -> {metric: scalar}`, jittable, of one trial; `params` is a dict with
            the value of every axis. Or a Study, or the name of one.
        space: name -> `grid`, `uniform`, `loguniform`, `integers`, `choice` or `categorical`.
        seeds: trials per setting.
        out: the folder.
        samples: settings to draw where the space has ranges; each is crossed with all values of
            the `grid` axes.
        design: "grid", "sobol", "random", or adaptive: "tpe", "cma", "gp"; grid without and sobol
            with samples when left out.
        objective: metric to rank by; the first that the trial returns when left out.
        goal: "max" or "min"; "max" when left out.
        metrics: unit, text and goal of metrics; an `optional` one may be NaN.
        root: seed of all keys.
        common_seeds: seed k draws the same numbers in every setting, for paired comparisons.
        workers: processes on this machine.
        chunk_size: trials side by side on a device: a number, "all", or "auto" (measured).
        chunk_trials: trials per file.
        overwrite: delete the sweep that is in the folder first.
        retry_failed: run trials again that raised an exception.
        allow_mixed: go on though the trial's source has changed; the results say so.
        choices: `budgets`, `keep`, `mode` (halving); `batch` (adaptive); `min_valid`; `lease`.

    Returns:
        xarray.Dataset: a dimension per axis of a grid, or `setting`, and `seed`; a variable per
        metric, and `status`.

    Raises:
        ValueError: what is asked for cannot run, or does not fit the folder.
        WorkFailedError: trials raised exceptions or chunks are missing; the message tells which,
            and the folder has the rest.

    Example:
        >>> import tempfile, jax
        >>> from snn_fusion_failure.sweeps import grid
        >>> def trial(params, key):
        ...     return {"error": params["step"] * jax.random.normal(key) ** 2}
        >>> with tempfile.TemporaryDirectory() as out:
        ...     data = sweep(trial, {"step": grid(1.0, 2.0)}, seeds=3, out=out, goal="min",
        ...                  chunk_size=2)
        >>> dict(data.sizes)
        {'step': 2, 'seed': 3}
    """
    from snn_fusion_failure.sweeps.launchers import launch_local

    enable_compilation_cache()
    loaded: Trial | Study = load_study(trial) if isinstance(trial, str) else trial
    if goal and goal not in ("max", "min"):
        raise ValueError(f"goal={goal!r}: expected 'max' or 'min'")
    if isinstance(loaded, Study):
        study, axes = loaded, axes_of(space, loaded)
    else:
        axes = axes_of(space)
        study = from_trial(loaded, axes, metrics=metrics, objective=objective)
    if objective or goal:
        study = with_objective(study, objective, goal)
    kind = design or ("sobol" if samples else "grid")
    made = build(
        study, kind, axes, Path(out), samples=samples, seeds=seeds, root=root,
        common=common_seeds, allow_mixed=allow_mixed, **choices,
    )  # fmt: skip
    layout = Layout(str(chunk_size), chunk_trials, workers)
    opened = open_sweep(made, layout, overwrite=overwrite, retry=retry_failed)
    run = None
    if workers > 1:

        def run(sweep: Any, on_chunk: Any) -> Sequence[str]:
            return launch_local(sweep, workers, on_chunk)

    errors = execute(opened, run=run)
    dataset, counts = collect(opened)
    if counts["failed"] or not counts["complete"]:
        first = f"; {brief(errors[0])}" if errors else ""
        raise WorkFailedError(f"{describe(counts)} in {out}{first}")
    return dataset


def with_objective(study: Study, objective: str | None, goal: str = "") -> Study:
    """The study, ranked by another metric or the other way.

    Raises:
        ValueError: the metric is unknown, or it is not known which way it is better.
    """
    import dataclasses

    name = objective or study.objective
    if name not in study.metrics:
        raise ValueError(f"objective={name!r}: expected one of {', '.join(study.metrics)}")
    way: Any = goal or study.metrics[name].goal
    metrics = {**study.metrics, name: dataclasses.replace(study.metrics[name], goal=way)}
    return dataclasses.replace(study, metrics=metrics, objective=name)
