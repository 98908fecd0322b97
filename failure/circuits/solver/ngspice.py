"""ngspice as the trusted reference: run decks (`decks`), one process each, and read the numbers."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np


class NgspiceError(RuntimeError):
    """ngspice is missing, ran out of time, failed, or printed no result."""


def available() -> bool:
    """Whether an `ngspice` executable is on the path."""
    return shutil.which("ngspice") is not None


def require() -> str:
    """Path of the executable.

    Raises:
        NgspiceError: not installed.
    """
    path = shutil.which("ngspice")
    if path is None:
        raise NgspiceError(
            "ngspice is not installed or not on PATH; install it (Debian, Ubuntu: "
            "apt-get install ngspice; conda: conda install -c conda-forge ngspice) or leave the "
            "ngspice check out"
        )
    return path


_NUMBER = re.compile(r"^\s*([\w().\[\]]+)\s*=\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*$")


def run(text: str, *, timeout: float = 60.0) -> dict[str, float]:
    """Run one deck and read every line `name = number`; the last one of a name wins.

    Args:
        text: the deck.
        timeout: limit [s].
    Returns:
        Numbers by name (lower case).
    Raises:
        NgspiceError: not installed, out of time, or ngspice reported an error.
    """
    path = require()
    with tempfile.TemporaryDirectory(prefix="ngspice_") as folder:
        file = Path(folder) / "deck.cir"
        file.write_text(text, encoding="utf-8")
        try:
            done = subprocess.run(
                [path, "-b", "-n", str(file)],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=timeout,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise NgspiceError(f"ngspice took more than {timeout} s; raise the limit") from error
    out = {}
    for line in done.stdout.splitlines():
        match = _NUMBER.match(line)
        if match:
            out[match[1].lower()] = float(match[2])
    if not out:
        tail = (done.stderr + done.stdout)[-400:].strip()
        raise NgspiceError(f"ngspice printed no result (exit status {done.returncode}): {tail}")
    return out


def run_many(
    decks: Sequence[str], names: Sequence[str], *, workers: int = 2, timeout: float = 60.0
) -> tuple[np.ndarray, np.ndarray]:
    """Run decks side by side.

    Args:
        decks: one text per sample.
        names: numbers to read from each.
        workers: processes at a time.
        timeout: limit of each [s].
    Returns:
        (numbers `[n, names]`, NaN where missing; status `[n]`, 1 where a run failed).
    Raises:
        NgspiceError: not installed.
    """
    require()

    def one(text: str) -> list[float]:
        try:
            found = run(text, timeout=timeout)
        except NgspiceError:
            found = {}
        return [found.get(n, float("nan")) for n in names]

    with ThreadPoolExecutor(max_workers=workers) as pool:
        numbers = np.array(list(pool.map(one, decks))).reshape(len(decks), len(names))
    return numbers, np.any(~np.isfinite(numbers), axis=1).astype(np.int32)
