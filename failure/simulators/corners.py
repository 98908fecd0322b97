"""Process corners with temperature and supply lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from failure.simulators.spice import parse_number


class Corner(NamedTuple):
    """A condition in which every sample is simulated: parameters, temperature, library section."""

    name: str
    values: tuple[tuple[str, float], ...] = ()
    temperature: float | None = None
    section: str | None = None


def _values(text: str, name: str) -> dict[str, str]:
    found = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        key, equals, value = (p.strip() for p in part.partition("="))
        if not equals or not key or not value:
            raise ValueError(f"corners={name!r}: expected NAME:PARAMETER=VALUE,...; got {part!r}")
        found[key.lower()] = value
    return found


def parse_corner(text: str) -> Corner:
    """`ss:vtn=0.5,kpn=160u,temp=125,lib=ss`; a name alone is the netlist as it stands.

    Raises:
        ValueError: another form.

    Example:
        >>> parse_corner("hot:temp=125,vdd=1.6")
        Corner(name='hot', values=(('vdd', 1.6),), temperature=125.0, section=None)
    """
    name, _, rest = text.partition(":")
    given = _values(rest, name)
    section = given.pop("lib", None)
    temperature = given.pop("temp", None)
    return Corner(
        name.strip(),
        tuple((k, parse_number(v)) for k, v in given.items()),
        None if temperature is None else float(temperature),
        section,
    )


def pvt_corners(corners: Sequence[str], lists: Sequence[str]) -> tuple[Corner, ...]:
    """All corners: each process corner at each combination of the lists.

    Args:
        corners: see `parse_corner`; the netlist as it stands when there are none.
        lists: `temp=-40,27,125`, `vdd=1.62,1.8,1.98`: a parameter or the temperature, its values.
    Raises:
        ValueError: another form, or two corners of one name.

    Example:
        >>> [c.name for c in pvt_corners(["tt", "ss:vtn=0.5"], ["temp=27,125"])]
        ['tt temp=27', 'tt temp=125', 'ss temp=27', 'ss temp=125']
    """
    found = [parse_corner(c) for c in corners] or [Corner("nominal")]
    for text in lists:
        name, equals, values = (p.strip() for p in text.partition("="))
        options = [v.strip() for v in values.split(",") if v.strip()]
        if not equals or not options:
            raise ValueError(f"pvt={text!r}: expected PARAMETER=VALUE,VALUE,... or temp=...")
        longer = []
        for corner in found:
            for option in options:
                label = f"{name}={option}"
                full = label if corner.name == "nominal" else f"{corner.name} {label}"
                if name.lower() == "temp":
                    longer.append(corner._replace(name=full, temperature=float(option)))
                else:
                    pair = (name.lower(), parse_number(option))
                    longer.append(corner._replace(name=full, values=(*corner.values, pair)))
        found = longer
    names = [c.name for c in found]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"corners={twice[0]!r}: expected once; two corners have this name")
    return tuple(found)
