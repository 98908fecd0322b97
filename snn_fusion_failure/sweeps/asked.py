"""Axes as a command line gives them, for a study or for a function of one trial."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

from snn_fusion_failure.sweeps.axes import Axis, parse_axis
from snn_fusion_failure.sweeps.front import with_objective
from snn_fusion_failure.sweeps.leaves import parse_number
from snn_fusion_failure.sweeps.study import Study, load_study
from snn_fusion_failure.sweeps.trial import from_trial

DRAWN = ("random", "sobol", "tpe", "cma", "gp")
"""Designs whose settings are drawn; their names are the options that list their axes."""


def read_axes(
    name: str,
    options: Sequence[str],
    given: Mapping[str, Sequence[str]],
    *,
    objective: str | None = None,
    goal: str = "",
) -> tuple[str, list[Axis], Study]:
    """Kind of the design, its axes, and the study.

    Args:
        name: of the study, or where a function is.
        options: of the study, `name=value`.
        given: `grid`, `choice` and the names of `DRAWN` -> axes, `leaf=values`.
        objective, goal: which metric settings are ranked by, and which way.

    Raises:
        ValueError: no axis, axes of two designs, or an axis that cannot be read.
    """
    drawn = [k for k in DRAWN if given[k]]
    if len(drawn) > 1 or not (drawn or given["grid"] or given["choice"]):
        raise ValueError(
            f"{' and '.join(drawn) or 'no axis'} given: give one of --grid, --random, --sobol, "
            "--tpe, --cma, --gp, for example --grid drive=16:40:13"
        )
    loaded = load_study(name, options)
    study = loaded if isinstance(loaded, Study) else None
    axes = []
    for kind in ("grid", "choice", *drawn):
        for text in given[kind]:
            axis = parse_axis(
                text,
                functools.partial(_kind_of, option=kind, text=text, study=study),
                study.unit_of if study else lambda leaf: "",
            )
            axes.append(axis._replace(every=kind == "grid" and bool(drawn)))
    if study is None:
        study = from_trial(loaded, axes, name=name)
    if objective or goal:
        study = with_objective(study, objective, goal)
    return (drawn or ["grid"])[0], axes, study


def _kind_of(name: str, option: str, text: str, study: Study | None) -> Any:
    """Leaf, kind and default of an axis; of a trial, words are static and numbers are traced."""
    if study is not None:
        leaf, kind, default = study.axis_of(name)
        if option == "choice" and kind != "static":
            static = ", ".join(study.options)
            raise ValueError(
                f"choice={text!r}: expected an option of the study ({static}); {leaf} compiles "
                "nothing anew, give it to --grid"
            )
        return leaf, kind, default
    body = text.partition("=")[2]
    words = any(not _is_number(part) for part in body.split(",") if ":" not in part)
    return name, "static" if words or option == "choice" else "float", None


def _is_number(text: str) -> bool:
    try:
        parse_number(text, "", "")
    except ValueError:
        return False
    return True
