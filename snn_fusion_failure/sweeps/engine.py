"""A sweep from what is asked for to the data set: build, open, run, sum up.

Both the command line and `sweeps.sweep` go through these four steps.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps import adaptive, rungs
from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.chunkfile import set_aside
from snn_fusion_failure.sweeps.chunks import Progress, run_shard
from snn_fusion_failure.sweeps.definition import FAILED, MISSING, NON_FINITE, Sweep
from snn_fusion_failure.sweeps.designs import ADAPTIVE, design, shares
from snn_fusion_failure.sweeps.folder import claim, forget, held_sweep
from snn_fusion_failure.sweeps.gather import RESERVED, damaged, gather, write_netcdf
from snn_fusion_failure.sweeps.leaves import batch
from snn_fusion_failure.sweeps.rank import rank
from snn_fusion_failure.sweeps.results import Reader
from snn_fusion_failure.sweeps.source import folder_of
from snn_fusion_failure.sweeps.study import Study
from snn_fusion_failure.sweeps.worker import check_source, retry_failed


@dataclasses.dataclass(frozen=True)
class Layout:
    """How trials are dealt out; changes no numbers.

    Attributes:
        chunk_size: trials side by side on a device: 1 (one after another), a number, `all`, or
            `auto` (measured).
        chunk_trials: trials per file; 0: 16 or what runs side by side, whichever is more.
        parts: workers among which they are dealt out.
    """

    chunk_size: str = "auto"
    chunk_trials: int = 0
    parts: int = 1


def parse_shard(text: str) -> tuple[int, int]:
    """`i/n` as numbers.

    Raises:
        ValueError: not of that form, or i is not in 0 ... n - 1.

    Example:
        >>> parse_shard("3/8")
        (3, 8)
    """
    left, slash, right = text.partition("/")
    if not (slash and left.isdigit() and right.isdigit() and int(left) < int(right)):
        raise ValueError(f"shard={text!r}: expected i/n with i from 0 to n - 1, for example 0/4")
    return int(left), int(right)


def build(
    study: Study,
    kind: str,
    axes: Sequence[Axis],
    out: Path,
    *,
    samples: int = 0,
    design_seed: int = 0,
    seeds: int = 8,
    **choices: Any,
) -> Sweep:
    """The sweep that is asked for, checked, before anything is compiled.

    Args:
        study: what a trial is.
        kind, axes, samples, design_seed: of the design.
        out: its folder.
        seeds: trials per setting.
        choices: further fields of `Sweep`: `root`, `budgets`, `keep`, `mode`, `common`, `batch`,
            `min_valid`, `allow_mixed`, `lease`.

    Raises:
        ValueError: names what cannot run and what is expected.
    """
    if seeds < 1:
        raise ValueError(f"seeds={seeds}: expected at least 1")
    made = design(kind, axes, samples=samples, seed=design_seed)
    trials = max(made.n, samples) * seeds
    if trials > np.iinfo(np.int32).max:
        raise ValueError(f"{trials} trials: expected at most 2**31 - 1; sweep in parts")
    _check_names(study, [axis.leaf for axis in made.axes])
    budgets = tuple(choices.pop("budgets", ()))
    sweep = Sweep(
        out, study, made, seeds, budgets=budgets, metrics=study.metrics,
        objective=study.objective, rung_objective=study.rung_objective(budgets),
        budget_text=study.budget_text, study_name=study.name, options=study.options,
        where=folder_of(study.source), **choices,
    )  # fmt: skip
    if not 0.0 <= sweep.min_valid <= 1.0:
        raise ValueError(f"min_valid={sweep.min_valid}: expected a share between 0 and 1")
    if not sweep.lease > 0.0:
        raise ValueError(f"lease={sweep.lease}: expected a positive number of seconds")
    rungs.check_halving(sweep)
    if kind in ADAPTIVE:
        adaptive.check_adaptive(sweep)
    _check_settings(sweep)
    return sweep


def _check_names(study: Study, leaves: Sequence[str]) -> None:
    """Metrics and axes stand side by side in one data set: refuse two of one name."""
    for kind, names in (("metric", list(study.metrics)), ("axis", list(leaves))):
        taken = sorted(set(names) & set(RESERVED))
        if taken:
            raise ValueError(
                f"{kind}={taken[0]!r}: expected another name; the data set has {taken[0]} of its "
                "own; rename it"
            )
    both = sorted(set(study.metrics) & set(leaves))
    if both:
        raise ValueError(
            f"metric={both[0]!r}: expected a name that no axis has; rename the metric or the axis"
        )


def _check_settings(sweep: Sweep) -> None:
    """Let the study look at every setting, variant by variant.

    Raises:
        ValueError: from the study, for a setting that cannot run.
    """
    groups: dict[str, list[tuple[Any, ...]]] = {}
    for row in sweep.design.rows:
        groups.setdefault(repr(sweep.static_values(row)), []).append(row)
    for rows in groups.values():
        study = sweep.study
        assert study is not None
        static = sweep.static_values(rows[0])
        if static:
            assert study.variant is not None
            study = study.variant(static)
        units = {leaf: study.unit_of(leaf) for leaf in study.leaves}
        study.check(batch(study.params, sweep.columns(rows), len(rows), units, "float64"))


def lay_out(sweep: Sweep, layout: Layout) -> tuple[Sweep, dict[str, Any]]:
    """Chunk size and trials per file; measures where asked to, and says what it measured."""
    import jax

    from snn_fusion_failure.sweeps.program import fastest, measure_widths

    devices = len(jax.devices())
    rows = list(sweep.design.rows)
    if not rows:
        points = shares("sobol", len(sweep.design.axes), max(8, sweep.batch), sweep.design.seed)
        rows = adaptive.rows_at(sweep.design.axes, points)
    share = -(-len(rows) * sweep.seeds // layout.parts)
    noted: dict[str, Any] = {}
    text = layout.chunk_size
    if text == "all":
        width = -(-(layout.chunk_trials or share) // devices)
    elif text == "auto":
        # Up to 64 trials per device, from all over the sweep: the slowest of a batch sets its time.
        static = sweep.static_values(rows[0])
        same = [row for row in rows if sweep.static_values(row) == static]
        most = min(share, (layout.chunk_trials or 64) * devices, len(same) * sweep.seeds)
        trials = np.linspace(0, len(same) * sweep.seeds - 1, most).astype(int)
        few = [same[i] for i in trials // sweep.seeds]
        study = sweep.study
        assert study is not None
        if static:
            assert study.variant is not None
            study = study.variant(static)
        seconds = measure_widths(
            study, sweep.columns(few), sweep.words(few), trials % sweep.seeds, root=sweep.root
        )
        width = fastest(seconds)
        noted["measured_seconds_per_trial"] = {str(k): v for k, v in seconds.items()}
        shown = ", ".join(f"{k}: {1e3 * v:.3g} ms" for k, v in seconds.items())
        print(f"chunk size {width}; measured per trial {shown}", file=sys.stderr)
    elif text.isdigit() and int(text) > 0:
        width = int(text)
    else:
        raise ValueError(f"chunk_size={text!r}: expected a number from 1 on, all, or auto")
    if layout.chunk_trials < 0:
        raise ValueError(f"chunk_trials={layout.chunk_trials}: expected at least 1, or 0 for auto")
    side_by_side = width * devices
    # Whole calls: a file that is no multiple of a call would be filled up with repeats.
    per_file = layout.chunk_trials or -(-max(16, side_by_side) // side_by_side) * side_by_side
    return dataclasses.replace(sweep, width=width, chunk_trials=per_file), noted


def open_sweep(
    sweep: Sweep, layout: Layout, *, overwrite: bool = False, retry: bool = False
) -> Sweep:
    """Claim the folder, or go on with the sweep in it; let it grow to what is asked for."""
    if overwrite:
        forget(sweep.out)
    noted: dict[str, Any] = {}
    if (sweep.out / "sweep.json").exists():
        sweep = claim(sweep)  # refuses other settings before anything is measured
    else:
        sweep, noted = lay_out(sweep, layout)
    sweep = claim(sweep, **noted)
    rungs.grow(sweep)
    if retry:
        print(f"{retry_failed(sweep)} failed trials will be run again", file=sys.stderr)
    if not rungs.is_complete(sweep):
        check_source(sweep)
    return dataclasses.replace(
        held_sweep(sweep.out, allow_mixed=sweep.allow_mixed, lease=sweep.lease), study=sweep.study
    )


def execute(
    sweep: Sweep,
    *,
    run: Callable[[Sweep, Callable[[Progress], None]], Sequence[str]] | None = None,
    on_chunk: Callable[[Progress], None] = lambda progress: None,
) -> list[str]:
    """Run what is missing; damaged chunks are set aside, named, and computed again.

    Args:
        sweep: opened.
        run: runs what is missing and returns what went wrong; in this process when left out.
        on_chunk: called after each chunk.
    """

    def here(sweep: Sweep, on_chunk: Callable[[Progress], None]) -> Sequence[str]:
        return run_shard(sweep, on_chunk=on_chunk).errors

    import jax

    errors: list[str] = []
    for _ in range(3):
        # Processes of a distributed run look together or not at all.
        if jax.process_count() > 1 or not rungs.is_complete(sweep):
            errors += (run or here)(sweep, on_chunk)
        broken = damaged(sweep)
        for path in broken:
            place = os.path.relpath(set_aside(path), sweep.out)
            print(f"warning: {path} was damaged; moved to {place}, run again", file=sys.stderr)
        if not broken:
            break
    return errors


def collect(sweep: Sweep, *, write: bool = True) -> tuple[Any, dict[str, Any]]:
    """What is there as a data set (also as `results.nc`), with counts and the best setting.

    Damaged chunks are named and left out.

    Returns:
        The data set, and `complete`, `trials`, `of`, `non_finite`, `failed`, `missing`,
        `objective`, `best` and the axes of the best setting, `out`.
    """
    reader = Reader(sweep.out)
    for path in damaged(sweep, reader):
        print(f"warning: {path} is damaged and left out; run the sweep again", file=sys.stderr)
        reader.skip(path)
    dataset = gather(sweep, reader=reader)
    if write:
        write_netcdf(dataset, sweep.out / "results.nc")
    status = np.asarray(dataset["status"])
    rows = rank(dataset)
    result: dict[str, Any] = {
        "complete": bool(dataset.attrs["complete"]),
        "trials": int((status != MISSING).sum()),
        "of": int(status.size),
        "non_finite": int((status == NON_FINITE).sum()),
        "failed": int((status == FAILED).sum()),
        "missing": int(dataset.attrs["chunks_missing"]),
        "objective": dataset.attrs["objective"],
    }
    if rows:
        result |= {"best": rows[0]["mean"], **rows[0]["axes"]}
    return dataset, result | {"out": str(sweep.out)}


def describe(fields: Mapping[str, Any]) -> str:
    """Counts of `collect` in one line."""
    return (
        f"{fields['trials']} of {fields['of']} trials, {fields['failed']} failed, "
        f"{fields['missing']} chunks missing"
    )
