"""Maps in files: a JSON object of what `maps.make_map` takes, checked before anything runs.

    {"target": [400, 300], "starts": [[90, 300, 40]],
     "polygons": [[[200, 250], [260, 250], [260, 350], [200, 350]]], "circles": [[550, 300, 40]]}

Lengths in pixels, y upwards, angles in degrees. `target` and `starts` must be there; every other
argument of `make_map` may be (bounds, speed, noise, velocities, dead sonars).
"""

from __future__ import annotations

import difflib
import inspect
import json
from pathlib import Path
from typing import Any

from jaxsnn import families, scenarios
from jaxsnn.maps import make_map
from jaxsnn.world import WorldParams

FIELDS = tuple(inspect.signature(make_map).parameters)
NEEDED = ("target", "starts")
# How deep numbers are nested: 0 a number, 1 a list of numbers, ...
_DEPTH = {
    "polygons": 3, "circles": 2, "starts": 2, "polygon_velocity": 2, "circle_velocity": 2,
    "bounds": 1, "target": 1, "start_probs": 1, "sonar_angles": 1,
}  # fmt: skip


def load_map(path: str | Path) -> WorldParams:
    """The map in a JSON file.

    Raises:
        ValueError: the file is missing or not JSON, a field is unknown, missing or of the wrong
            form, or `make_map` refuses the map; the message names file, field and fix.
    """
    path = Path(path)
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(
            f"map={path}: expected a file to read, {error.strerror}; check it"
        ) from error
    except ValueError as error:  # not UTF-8, or not JSON
        raise ValueError(f"map={path}: expected JSON, {error}; mend it") from error
    try:
        return make_map(**_arguments(given))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def named_map(name: str) -> WorldParams:
    """A map by name: `S1` to `S3`, `D1` to `D3`, FAMILY/SPLIT/NUMBER, or a JSON file.

    Raises:
        ValueError: there is no such map.

    Example:
        >>> named_map("D1").target.tolist()
        [400.0, 300.0]
    """
    if name in ("S1", "S2", "S3"):
        return scenarios.scenario(int(name[1]))
    if name in ("D1", "D2", "D3"):
        return scenarios.detour(int(name[1]))
    family, _, rest = name.partition("/")
    split, _, number = rest.partition("/")
    if family in families.FAMILIES and number.isdecimal() and not Path(name).exists():
        return families.family_map(family, split, int(number))
    if not name.endswith(".json"):
        raise ValueError(
            f"map={name}: expected S1 to S3, D1 to D3, FAMILY/SPLIT/NUMBER such as "
            f"detour/train/0 (families {', '.join(families.FAMILIES)}), or a .json file; choose one"
        )
    return load_map(name)


def _arguments(given: Any) -> dict[str, Any]:
    """Checked arguments of `make_map`."""
    if not isinstance(given, dict):
        raise ValueError(
            f"map=<{type(given).__name__}>: expected an object with target and starts; use {{}}"
        )
    for name in given:
        if name not in FIELDS:
            close = difflib.get_close_matches(name, FIELDS, n=1)
            fix = f"did you mean {close[0]}?" if close else f"choose of {', '.join(FIELDS)}"
            raise ValueError(f"{name}={given[name]}: expected a known field; {fix}")
    for name in NEEDED:
        if name not in given:
            raise ValueError(f"{name}=<missing>: expected it in the file; add it")
    arguments = dict(given)
    if "sonar_stuck" in given:
        stuck = given["sonar_stuck"]
        if not isinstance(stuck, dict) or not all(k.isdecimal() for k in stuck):
            raise ValueError(
                f'sonar_stuck={stuck}: expected {{"0": what it reports}}; count sonars from 0'
            )
        arguments["sonar_stuck"] = {int(k): v for k, v in stuck.items()}
    for name, value in given.items():
        depth = _DEPTH.get(name, 0)
        if name != "sonar_stuck" and not _is_nested(value, depth):
            form = "a number" if depth == 0 else "numbers in " + "lists of " * (depth - 1) + "lists"
            raise ValueError(f"{name}={value}: expected {form}; see the example in the docs")
    return arguments


def _is_nested(value: Any, depth: int) -> bool:
    if depth == 0:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, list) and all(_is_nested(v, depth - 1) for v in value)
