"""`--set part.name=value`: one grammar to change a constant, in train, sweep and study."""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Mapping, Sequence
from typing import Any


def _fields(part: Any) -> dict[str, Any]:
    """Names and values of a dataclass or a named tuple."""
    if dataclasses.is_dataclass(part):
        return {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    return dict(part._asdict())


def _replace(part: Any, name: str, value: Any) -> Any:
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        return dataclasses.replace(part, **{name: value})
    return part._replace(**{name: value})


def parse_value(text: str) -> Any:
    """A JSON value, or the text itself where it is none: `5e-4`, `true`, `[16, 32]`, `soft`."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _convert(change: str, old: Any, value: Any) -> Any:
    """`value` as the type of the constant that it replaces, or ValueError."""
    if isinstance(old, tuple) and isinstance(value, list):
        return tuple(value)
    if isinstance(old, bool) or isinstance(value, bool):
        fits = isinstance(old, bool) and isinstance(value, bool)
    elif isinstance(old, int):
        fits = isinstance(value, int)
    elif isinstance(old, float) or hasattr(old, "dtype"):
        fits = isinstance(value, int | float)
        value = float(value) if fits else value
    elif isinstance(old, str):
        fits = isinstance(value, str)
    else:
        fits = True
    if not fits:
        raise ValueError(f"set={change!r}: expected a value like {old!r}; got {value!r}")
    return value


def apply_changes(parts: Mapping[str, Any], changes: Sequence[str]) -> dict[str, Any]:
    """The parts of a run with some constants changed.

    Args:
        parts: name -> frozen dataclass or named tuple, nested as it may be: `{"params": ...}`.
        changes: `part.name=value` or `part.inner.name=value`; the value is JSON or a bare word.

    Returns:
        The same names with changed parts; what is checked when a part is made is checked again.

    Raises:
        ValueError: a change is not of that form, names nothing, or has a value of another type.

    Example:
        >>> from jaxsnn.neurons import LIFParams
        >>> apply_changes({"neuron": LIFParams()}, ["neuron.tau_m=0.01"])["neuron"].tau_m
        0.01
    """
    made = dict(parts)
    for change in changes:
        left, equals, text = change.partition("=")
        first, *rest = left.split(".")
        if not equals or not rest or first not in made:
            raise ValueError(
                f"set={change!r}: expected part.name=value with part one of "
                f"{', '.join(made)}; for example --set {next(iter(made))}.NAME=VALUE"
            )
        holders = [made[first]]
        for depth, name in enumerate(rest):
            known = (
                _fields(holders[-1])
                if hasattr(holders[-1], "_asdict") or (dataclasses.is_dataclass(holders[-1]))
                else {}
            )
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f"; did you mean {near[0]}?" if near else ""
                where = ".".join([first, *rest[:depth]])
                raise ValueError(
                    f"set={change!r}: expected a constant of {where} "
                    f"({', '.join(known) or 'it has none'}){hint}"
                )
            holders.append(known[name])
        value = _convert(change, holders[-1], parse_value(text))
        for holder, name in zip(reversed(holders[:-1]), reversed(rest), strict=True):
            value = _replace(holder, name, value)
        made[first] = value
    return made
