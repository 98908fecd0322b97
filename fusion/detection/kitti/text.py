"""Reading KITTI's text files: a wrong token is named with its file and line."""

from __future__ import annotations

import codecs
from pathlib import Path

import numpy as np


def read_lines(path: Path) -> list[str]:
    """The lines of an ASCII file; a byte-order mark before them, as editors leave it, is skipped.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not ASCII.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected a KITTI file of this frame")
    try:
        return path.read_bytes().removeprefix(codecs.BOM_UTF8).decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: byte {error.start} is not ASCII: not a KITTI text file"
        ) from None


def parse_number(token: str, path: Path, line: int, name: str) -> float:
    """A finite number, or a ValueError that names file, line, what it is and what was found."""
    try:
        value = float(token)
    except ValueError:
        raise ValueError(f"{path}, line {line}: {name} is {token!r}, expected a number") from None
    if not np.isfinite(value):
        raise ValueError(f"{path}, line {line}: {name} is {token!r}, expected a finite number")
    return value
