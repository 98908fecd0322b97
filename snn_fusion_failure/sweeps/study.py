"""What a sweep sweeps: a study is a pure batched function of parameters and keys.

Built-in studies are found by name; your own by `module:function` or `folder/file.py:function`, in
the current directory or on the path. The function is a trial, `(params, key) -> {metric: number}`,
or it takes keyword options and returns a `Study`.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

from snn_fusion_failure.sweeps.leaves import leaf_names, resolve

# name -> where it is made
STUDIES = {
    "snn": "snn_fusion_failure.sweeps.studies.snn:make",
    "argate": "snn_fusion_failure.sweeps.studies.argate:make",
    "failure": "snn_fusion_failure.sweeps.studies.failure:make",
    "lif": "snn_fusion_failure.sweeps.studies.lif:make",
}


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number per trial.

    Raises:
        ValueError: a goal that is none.

    Example:
        >>> Metric("%", "share of trials that arrive", "max").goal
        'max'
    """

    unit: str = ""
    text: str = ""
    goal: Literal["max", "min", ""] = ""
    """Which way is better; empty for a number that is not ranked by."""
    optional: bool = False
    """NaN is an answer ("never arrived"), not a trial that broke."""

    def __post_init__(self) -> None:
        """Refuse a goal that is none."""
        if self.goal not in ("max", "min", ""):
            raise ValueError(f"goal={self.goal!r}: expected 'max', 'min' or ''")


@dataclasses.dataclass(frozen=True)
class Carry:
    """How a study is gone on with from where a smaller budget ended.

    Attributes:
        init: `(params [w], keys [w]) -> carry`, leaves `[w, ...]`.
        advance: `(params, keys, carry, begin, end) -> (carry, metrics)`: the units `begin` to
            `end - 1`, static numbers. In one go or in parts the result is the same, to the bit.
        total: the budget of a whole trial.
        objective: what settings are ranked by before the end, and the only metric that has to be a
            number there; the study's own when left out.

    Example:
        >>> Carry(lambda p, k: p, lambda p, k, c, begin, end: (c, {"spread": c}), total=8).total
        8
    """

    init: Callable[[Any, Any], Any]
    advance: Callable[[Any, Any, Any, int, int], tuple[Any, dict[str, Any]]]
    total: int
    objective: str = ""


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
        carry: how a cut trial is gone on with; None where it starts anew.
        variant: the study with other options, for static axes; None where it has none.
        source: what its fingerprint starts from: a function or a module's name.

    Raises:
        ValueError: an objective that is not among the metrics, or that has no direction.

    Example:
        >>> metrics = {"x": Metric(goal="min")}
        >>> study = Study("mine", {}, (1.0,), lambda p, keys: {"x": p[0]}, metrics, "x")
        >>> study.dtype
        'float32'
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
    carry: Carry | None = None
    variant: Callable[[dict[str, Any]], Study] | None = None
    source: Any = None

    def __post_init__(self) -> None:
        """Refuse an objective that is not there or has no direction."""
        if self.objective not in self.metrics or not self.metrics[self.objective].goal:
            ranked = [name for name, metric in self.metrics.items() if metric.goal]
            raise ValueError(f"objective={self.objective!r}: expected one of {', '.join(ranked)}")

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of what can be swept without compiling anew."""
        return leaf_names(self.params)

    def rung_objective(self, budgets: Sequence[int]) -> str:
        """What settings are ranked by before they have all of their training."""
        if budgets and self.carry is not None:
            return self.carry.objective or self.objective
        if budgets and self.with_budget is not None:
            return self.with_budget(budgets[0]).objective
        return self.objective

    def axis_of(self, name: str) -> tuple[str, Any, Any]:
        """Leaf or option that a name means, the kind of its axis, and its default.

        Raises:
            ValueError: it is neither; the message lists the leaves.
        """
        try:
            return resolve(name, self.leaves), "float", None
        except ValueError as error:
            if self.variant is not None and name in self.options:
                return name, "static", self.options[name]
            more = f"; options that can be axes: {', '.join(self.options)}" if self.variant else ""
            raise ValueError(f"{error}{more}") from None


def options_of(make: Callable[..., Any]) -> dict[str, Any]:
    """Options of a function that makes a study, with their defaults."""
    return {
        p.name: list(p.default) if isinstance(p.default, tuple) else p.default
        for p in inspect.signature(make).parameters.values()
    }


def is_trial(function: Callable[..., Any]) -> bool:
    """Whether a function is a trial, `(params, key)`, rather than one that makes a study."""
    parameters = inspect.signature(function).parameters.values()
    needed = [p for p in parameters if p.default is p.empty and p.kind is not p.KEYWORD_ONLY]
    return len(needed) == 2


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


def make_study(make: Callable[..., Study], name: str, options: dict[str, Any]) -> Study:
    """Call a function that makes a study, with options, and remember how to make it again."""
    study = make(**options)
    # The options as asked for make the study again, whatever `make` worked out from them.
    return dataclasses.replace(
        study, name=name, options=dict(options), source=make,
        variant=lambda static: make_study(make, name, {**options, **static}),
    )  # fmt: skip


def load_study(
    name: str, options: Sequence[str] = (), *, held: dict[str, Any] | None = None,
    where: str | None = None,
) -> Any:  # fmt: skip
    """A study by name, with options as strings, or as the values `held` in a sweep's folder.

    Args:
        name: of a built-in study, or where a function is.
        options: `name=value` strings.
        held: the options themselves.
        where: folder in which a module of one's own was found.

    Returns:
        Study; the function itself where it is a trial (it needs a space to become a study).

    Raises:
        ValueError: unknown study or option, or options that make no study.
    """
    from snn_fusion_failure.sweeps.source import find_function

    make = find_function(STUDIES.get(name, name), known=STUDIES, where=where)
    if is_trial(make):
        if options or held:
            given = ", ".join(options) or ", ".join(held or ())
            raise ValueError(f"options={given}: expected none for a trial; sweep them as axes")
        return make
    defaults = options_of(make)
    return make_study(make, name, held if held is not None else
                      parse_options(options, defaults, name))  # fmt: skip


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
