"""Numbers as SPICE writes them, and the numbers that a simulator prints."""

from __future__ import annotations

import re

_SCALE = {
    "t": 1e12, "g": 1e9, "meg": 1e6, "k": 1e3, "m": 1e-3, "mil": 25.4e-6, "u": 1e-6, "µ": 1e-6,
    "n": 1e-9, "p": 1e-12, "f": 1e-15,
}  # fmt: skip
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(meg|mil|[tgkmuµnpf])?[a-zΩ]*")

_PRINTED = re.compile(
    r"^\s*([\w.:()\[\]#@+-]+)\s*=\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|[-+]?inf|[-+]?nan)"
    r"(?![\w.])",
    re.IGNORECASE,
)


def parse_number(text: str) -> float:
    """A number with a SPICE suffix (`4.7k` = 4700, `1meg` = 1e6); letters after it are its unit.

    Raises:
        ValueError: no number.

    Example:
        >>> parse_number("20us"), parse_number("-1.5e-3"), parse_number("2Meg")
        (2e-05, -0.0015, 2000000.0)
    """
    match = _NUMBER.fullmatch(text.strip().lower())
    if match is None:
        raise ValueError(f"number={text!r}: expected a number like 20u, 4.7k, 1meg or 1e-6")
    # By way of the text, so that 20u is 2e-05 and not 1.9999999999999998e-05.
    scale = _SCALE.get(match[2] or "", 1.0)
    value = float(match[1]) * scale
    return float(f"{value:.15g}")


def format_number(value: float) -> str:
    """A number as a deck takes it.

    Example:
        >>> format_number(2e-05)
        '2e-05'
    """
    return f"{value:.12g}"


def printed_numbers(text: str) -> dict[str, float]:
    """All lines `name = number` of an output, names in lower case, the last one of a name.

    That is what `.meas`, `print` of a scalar and the measure files of other simulators look like.

    Example:
        >>> printed_numbers("TSET = 1.5e-08 targ= 2e-08 trig= 5e-09\\nnoise = failed")
        {'tset': 1.5e-08}
    """
    found = {}
    for line in text.splitlines():
        match = _PRINTED.match(line)
        if match:
            found[match[1].lower()] = float(match[2])
    return found


def printed_trouble(text: str, *, most: int = 4) -> str:
    """The lines of an output that say what went wrong, or its last ones."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    bad = [s for s in lines if re.search(r"error|fail|fatal|singular|too small|abort", s, re.I)]
    return " | ".join((bad or lines)[-most:])[-400:]
