"""Means over runs, paired tests and the bootstrap, for all chapters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from scipy import special


class Interval(NamedTuple):
    """Mean of n runs with a confidence interval and the standard deviation of one run."""

    mean: float
    low: float
    high: float
    sd: float
    n: int


class PairedTest(NamedTuple):
    """Mean difference of n paired runs, its interval, and the t test of no difference."""

    difference: float
    low: float
    high: float
    t: float
    p_value: float
    n: int


def _values(name: str, values: Sequence[float] | ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(
            f"{name}=array of shape {array.shape}: expected at least two runs in one axis; run "
            "more seeds"
        )
    if not np.isfinite(array).all():
        raise ValueError(
            f"{name}=array with NaN or infinity: expected finite values; a run has failed"
        )
    return array


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level={level}: expected a share in (0, 1); 0.95 is usual")


def mean_interval(values: Sequence[float] | ArrayLike, *, level: float = 0.95) -> Interval:
    r"""Mean over seeds and its confidence interval by Student's t.

    .. math:: \bar x \pm t_{n-1, (1 + p) / 2}\, s / \sqrt n

    Symbols: :math:`p` is `level`; :math:`s` is the standard deviation with n - 1 in the divisor.
    The interval of a share must not leave [0, 1]: see `records.intervals.share_interval`.

    Raises:
        ValueError: fewer than two values, non-finite values, or `level` outside (0, 1).
    """
    _check_level(level)
    x = _values("values", values)
    sd = float(x.std(ddof=1))
    half = float(special.stdtrit(x.size - 1, (1.0 + level) / 2.0)) * sd / x.size**0.5
    mean = float(x.mean())
    return Interval(mean, mean - half, mean + half, sd, x.size)


def bootstrap_interval(
    values: Sequence[float] | ArrayLike,
    groups: Sequence[int] | ArrayLike | None = None,
    *,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean and its percentile bootstrap interval, redrawing whole groups (subjects, seeds).

    Args:
        values: one number for each example or run.
        groups: what each value belongs to; groups are redrawn whole, so that values of one
            subject are not taken for independent. Every value is its own group when None.
        level: of the interval.
        draws: bootstrap samples.
        seed: of the redrawing.

    Returns:
        Interval; `n` is the number of groups. It never leaves the range of the values.

    Raises:
        ValueError: fewer than two values or groups, non-finite values, or a bad `level`.

    Source: Efron and Tibshirani (1993), chapters 13 and 8 (whole groups).
    """
    _check_level(level)
    x = _values("values", values)
    names = np.arange(x.size) if groups is None else np.asarray(groups)
    if names.shape != x.shape:
        raise ValueError(
            f"groups=array of shape {names.shape}: expected {x.shape}; give one for each value"
        )
    known, index = np.unique(names, return_inverse=True)
    if known.size < 2:
        raise ValueError(f"groups={known.tolist()}: expected at least two; redraw values instead")
    total, count = np.bincount(index, x), np.bincount(index)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, known.size, (draws, known.size))
    means = total[drawn].sum(axis=1) / count[drawn].sum(axis=1)
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(means, [tail, 1.0 - tail])
    return Interval(float(x.mean()), float(low), float(high), float(x.std(ddof=1)), known.size)


def paired_test(
    a: Sequence[float] | ArrayLike, b: Sequence[float] | ArrayLike, *, level: float = 0.95
) -> PairedTest:
    r"""Compare two models run by run (same seed, same corruption, same split).

    .. math:: d_i = a_i - b_i, \qquad t = \frac{\bar d}{s_d / \sqrt n}

    Args:
        a, b: a score of each model in each run, in the same order.
        level: of the interval of the mean difference.

    Returns:
        PairedTest with the two-sided p value. When all differences are equal, t is infinite and p
        is 0, or t is 0 and p is 1 if they are all zero.

    Raises:
        ValueError: different lengths, fewer than two runs, or non-finite values.

    Source: Student (1908).
    """
    x, y = _values("a", a), _values("b", b)
    if x.size != y.size:
        raise ValueError(f"b={y.size} runs: expected {x.size} as in a; pair the same runs")
    d = mean_interval(x - y, level=level)
    if d.sd > 0.0:
        t = d.mean / (d.sd / d.n**0.5)
    else:
        t = float(np.copysign(np.inf, d.mean)) if d.mean else 0.0
    p = 2.0 * float(special.stdtr(d.n - 1, -abs(t)))
    return PairedTest(d.mean, d.low, d.high, t, p, d.n)


def holm(p_values: Sequence[float]) -> list[float]:
    r"""P values of many tests, raised so that one false finding in all is as rare as promised.

    .. math:: p'_{(i)} = \max_{j \le i} \min\left(1, (m - j + 1)\, p_{(j)}\right)

    Returns:
        The adjusted values in the order given.

    Source: Holm (1979).

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
    """
    order = np.argsort(p_values, kind="stable")
    found, largest = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * float(p_values[index])))
        found[int(index)] = largest
    return found


def two_way_interval(
    values: Sequence[Sequence[float]] | ArrayLike,
    *,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of a table, both of its axes redrawn.

    Args:
        values: `[seed, subject]`, such as differences of two models; subjects count alike.
        level: of the interval.
        draws: bootstrap samples.
        seed: of the redrawing.

    Returns:
        (low, high): what other seeds and other subjects together could have given.

    Source: Owen (2007), the pigeonhole bootstrap.
    """
    _check_level(level)
    table = np.asarray(values, np.float64)
    rng = np.random.default_rng(seed)
    rows, columns = table.shape
    means = [
        table[np.ix_(rng.integers(0, rows, rows), rng.integers(0, columns, columns))].mean()
        for _ in range(draws)
    ]
    low, high = np.quantile(means, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return float(low), float(high)
