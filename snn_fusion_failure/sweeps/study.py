"""What a sweep sweeps: a study is a pure batched function of parameters and keys.

Built-in studies are found by name; a study of your own by `package.module:function`, where the
function takes keyword options and returns a `Study`.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

from snn_fusion_failure.sweeps.leaves import leaf_names

__all__ = ["STUDIES", "Metric", "Study", "load_study", "parse_options", "parse_pairs"]

# name -> where it is made
STUDIES = {
    "snn": "snn_fusion_failure.sweeps.studies.snn:make",
    "argate": "snn_fusion_failure.sweeps.studies.argate:make",
    "failure": "snn_fusion_failure.sweeps.studies.failure:make",
    "lif": "snn_fusion_failure.sweeps.studies.lif:make",
}


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number per trial."""

    unit: str
    text: str
    goal: Literal["max", "min", ""] = ""
    """Which way is better; empty for a number that is not ranked by."""
    optional: bool = False
    """NaN is an answer ("never arrived"), not a trial that broke."""


@dataclasses.dataclass(frozen=True)
class Study:
    """A trial, batched.

    Attributes:
        name: as on the command line.
        options: what was chosen, JSON values; enough to make the study again.
        params: a tree of scalar leaves; any of them can be an axis.
        run: `(params with leaves [w], keys [w]) -> {metric: [w]}`; jitted by the sweep. A trial's
            numbers may depend on its own parameters and key only.
        metrics: what `run` returns.
        objective: the metric that settings are ranked by.
        unit_of: the unit in which a leaf is swept; converted to the code's own.
        check: raises ValueError for a tree of concrete `[w]` leaves that cannot run.
        dtype: of the parameters; float64 switches 64-bit mode on around the compiled program.
        with_budget: the same study, cut after so many units of training, for successive halving;
            its `objective` must not need what was cut off. None where it makes no sense.
        budget_text: what a unit of the budget is.
    """

    name: str
    options: dict[str, Any]
    params: Any
    run: Callable[[Any, Any], dict[str, Any]]
    metrics: dict[str, Metric]
    objective: str
    unit_of: Callable[[str], str] = lambda leaf: ""
    check: Callable[[Any], None] = lambda params: None
    dtype: str = "float32"
    with_budget: Callable[[int], Study] | None = None
    budget_text: str = ""

    def __post_init__(self) -> None:
        """Refuse an objective that is not there or has no direction."""
        if self.objective not in self.metrics or not self.metrics[self.objective].goal:
            ranked = [name for name, metric in self.metrics.items() if metric.goal]
            raise ValueError(f"objective {self.objective!r}: expected one of {', '.join(ranked)}")

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of what can be swept."""
        return leaf_names(self.params)


def parse_options(texts: Sequence[str], defaults: dict[str, Any], study: str) -> dict[str, Any]:
    """`name=value` strings over the defaults of a study's options.

    Raises:
        ValueError: not of that form, an unknown name (the known ones are listed), or a value of
            another type.

    Example:
        >>> parse_options(["n_test=5"], {"n_test": 30, "network": "S4"}, "snn")
        {'n_test': 5, 'network': 'S4'}
    """
    chosen = dict(defaults)
    for text in texts:
        name, equals, body = text.partition("=")
        if not equals or name not in defaults:
            known = ", ".join(f"{k}={v}" for k, v in defaults.items())
            raise ValueError(f"option {text!r} of study {study}: known, with defaults: {known}")
        try:
            value = json.loads(body)
        except json.JSONDecodeError:
            value = body
        want = defaults[name]
        # A list option is written with commas, so that a shell needs no quotes.
        if isinstance(want, list) and not isinstance(value, list):
            value = [part for part in body.split(",") if part]
        elif isinstance(want, float) and type(value) is int:
            value = float(value)
        # A default of None says that the option may be left out: any value is checked later.
        if want is not None and type(value) is not type(want):
            wanted = type(want).__name__
            raise ValueError(f"option {name} of study {study}: {body!r} is no {wanted}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"option {name} of study {study}: {body!r} is not finite")
        chosen[name] = value
    return chosen


def load_study(
    name: str, options: Sequence[str] = (), *, held: dict[str, Any] | None = None
) -> Study:
    """A study by name, with options as strings, or as the values `held` in a sweep's folder.

    Raises:
        ValueError: unknown study or option, or options that make no study.
    """
    where = STUDIES.get(name, name)
    module, colon, function = where.partition(":")
    if not colon:
        raise ValueError(
            f"study {name!r}: expected one of {', '.join(STUDIES)}, or package.module:function "
            "that returns a Study"
        )
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"study {name!r} cannot be loaded: {error}") from error
    signature = inspect.signature(make)
    defaults = {
        p.name: list(p.default) if isinstance(p.default, tuple) else p.default
        for p in signature.parameters.values()
    }
    chosen = held if held is not None else parse_options(options, defaults, name)
    study: Study = make(**chosen)
    # The options as asked for make the study again, whatever `make` worked out from them.
    return dataclasses.replace(study, name=name, options=dict(chosen))


def parse_pairs(texts: Sequence[str], what: str) -> dict[str, Any]:
    """`name=value` strings, values as JSON where they are.

    Raises:
        ValueError: a string is not of that form.

    Example:
        >>> parse_pairs(["timeout_min=120", "slurm_partition=cpu"], "slurm")
        {'timeout_min': 120, 'slurm_partition': 'cpu'}
    """
    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, body = text.partition("=")
        if not equals or not name:
            raise ValueError(f"{what} {text!r}: expected name=value")
        try:
            pairs[name] = json.loads(body)
        except json.JSONDecodeError:
            pairs[name] = body
    return pairs
