"""What varies in a netlist: physical values of samples that a search describes in sigma."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from failure.simulators.spice import parse_number


class Varied(NamedTuple):
    """A parameter that varies: `nominal + sigma z`, or `nominal (1 + sigma z)` when relative."""

    name: str
    sigma: float
    relative: bool


def parse_varied(text: str) -> Varied:
    """`name:sigma`; a sigma in percent is relative to the nominal value.

    Raises:
        ValueError: another form, or a sigma that is not positive.

    Example:
        >>> parse_varied("rl:1%")
        Varied(name='rl', sigma=0.01, relative=True)
    """
    name, colon, sigma = (part.strip() for part in text.partition(":"))
    relative = sigma.endswith("%")
    try:
        value = parse_number(sigma.removesuffix("%"))
    except ValueError:
        colon = ""
        value = 0.0
    if not colon or not re.fullmatch(r"[A-Za-z_]\w*", name) or not value > 0.0:
        raise ValueError(
            f"vary={text!r}: expected NAME:SIGMA with SIGMA above 0, absolute (2m) or relative (1%)"
        )
    return Varied(name.lower(), value / 100.0 if relative else value, relative)


@dataclass(frozen=True)
class Variation:
    r"""The varied parameters and how they go together.

    .. math:: z = L x, \qquad L L^T = C, \qquad p = p_0 + \sigma z \ \text{ or }\ p_0 (1 + \sigma z)

    with `x` independent, each N(0, 1), and C the correlation matrix.
    """

    varied: tuple[Varied, ...]
    correlation: Float[np.ndarray, "d d"]

    def __post_init__(self) -> None:
        names = [v.name for v in self.varied]
        if not names:
            raise ValueError("vary=[]: expected at least one NAME:SIGMA")
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"vary={twice[0]!r}: expected once; it is given twice")
        matrix = np.asarray(self.correlation, np.float64)
        n = len(names)
        symmetric = matrix.shape == (n, n) and np.allclose(matrix, matrix.T)
        if not symmetric or not np.allclose(np.diag(matrix), 1.0):
            raise ValueError(
                f"correlation of shape {matrix.shape}: expected a symmetric [{n}, {n}] with ones "
                "on its diagonal"
            )
        least = float(np.linalg.eigvalsh(matrix)[0])
        if least <= 1e-9:
            raise ValueError(
                f"correlation: expected a positive definite matrix; its least eigenvalue is "
                f"{least:.3g}: the groups contradict each other, or two parameters are one"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(v.name for v in self.varied)

    @property
    def factor(self) -> Float[np.ndarray, "d d"]:
        """L, lower triangular."""
        return np.linalg.cholesky(np.asarray(self.correlation, np.float64))

    def physical(
        self, x: Float[np.ndarray, "n d"], nominal: Float[np.ndarray, "d"]
    ) -> Float[np.ndarray, "n d"]:
        """Values of the parameters of samples in sigma."""
        shift = np.asarray(x, np.float64) @ self.factor.T * self._scale(nominal)
        return nominal + shift

    def standard(
        self, values: Float[np.ndarray, "n d"], nominal: Float[np.ndarray, "d"]
    ) -> Float[np.ndarray, "n d"]:
        """Samples in sigma of given values, the inverse of `physical`."""
        z = (np.asarray(values, np.float64) - nominal) / self._scale(nominal)
        return np.linalg.solve(self.factor, z.T).T

    def _scale(self, nominal: Float[np.ndarray, "d"]) -> Float[np.ndarray, "d"]:
        relative = np.array([v.relative for v in self.varied])
        sigma = np.array([v.sigma for v in self.varied])
        zero = relative & (nominal == 0.0)
        if zero.any():
            name = self.names[int(np.argmax(zero))]
            raise ValueError(
                f"vary={name!r}: expected an absolute sigma; a relative one of a parameter that is "
                "0 is nothing"
            )
        return np.where(relative, np.abs(nominal), 1.0) * sigma


def _read_matrix(text: str) -> tuple[list[str], np.ndarray]:
    """Names and coefficients of a CSV file, its first line the names."""
    path = Path(text)
    if not path.is_file():
        raise FileNotFoundError(f"correlate={text!r}: expected a file; there is none")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            head, *rows = list(csv.reader(file)) or [[]]
        values = np.array(rows, np.float64)
        if not head or values.shape != (len(head), len(head)):
            raise ValueError(f"{len(head)} names over numbers of shape {values.shape}")
    except (ValueError, csv.Error) as error:
        raise ValueError(
            f"correlate={text!r}: expected a line of names and a square of numbers in UTF-8; "
            f"{error}"
        ) from error
    return head, values


def parse_variation(vary: Sequence[str], correlate: Sequence[str] = ()) -> Variation:
    """The variation that the options of a command describe.

    Args:
        vary: `name:sigma`, each.
        correlate: `a,b,c:0.8` gives all pairs of a group one coefficient; `FILE.csv` a whole
            matrix, its first line the names.
    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another form, an unknown name, or no correlation matrix.

    Example:
        >>> v = parse_variation(["a:1m", "b:2%"], ["a,b:0.5"])
        >>> v.physical(np.array([[1.0, 0.0]]), np.array([0.0, 100.0])).tolist()
        [[0.001, 101.0]]
    """
    varied = tuple(parse_varied(v) for v in vary)
    names = [v.name for v in varied]
    matrix = np.eye(len(names))

    def row(name: str, text: str) -> int:
        if name.strip().lower() not in names:
            raise ValueError(f"correlate={text!r}: expected names of vary ({', '.join(names)})")
        return names.index(name.strip().lower())

    for text in correlate:
        if text.lower().endswith(".csv"):
            head, values = _read_matrix(text)
            places = [row(name, text) for name in head]
            matrix[np.ix_(places, places)] = values
            continue
        members, colon, value = text.rpartition(":")
        try:
            coefficient = float(value)
        except ValueError:
            colon, coefficient = "", 0.0
        places = [row(name, text) for name in members.split(",")] if colon else []
        if len(places) < 2 or not -1.0 < coefficient < 1.0:
            raise ValueError(
                f"correlate={text!r}: expected NAME,NAME:RHO with RHO between -1 and 1, or FILE.csv"
            )
        for i in places:
            for j in places:
                if i != j:
                    matrix[i, j] = coefficient
    return Variation(varied, matrix)
