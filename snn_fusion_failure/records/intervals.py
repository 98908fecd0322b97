"""Intervals that fit what they are of: shares stay within 0 and 100 %, medians are ranks."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

SHARES = re.compile(
    r"sr_|success_rate|accuracy|average_precision|(?:2d|3d|bev)_\w+_r\d+|share_|collided"
    r"|gate_auroc|weight_auroc|mean_retained|(?:first|second)_stage$|(?:image|camera|lidar)$"
    r"|coverage$|known$|first_failure_share$"
)
"""Scores that are shares: of trials, of examples, of pairs (an AUROC), of runs."""
COUNTS = re.compile(r"(?:success_rate|coverage|known|first_failure_share)$")
"""Shares of independent runs that did something or not, kept as one number and `n`."""
SUCCESSES = re.compile(r"sr_|success_rate")
"""Shares of trials that end in success or not; each run has at least one."""


def bound(metric: str, unit: str | None) -> float | None:
    """100 or 1 for a share, None for any other score.

    Example:
        >>> bound("sr_testing", "%"), bound("success_rate", "1"), bound("n_mv", "steps")
        (100.0, 1.0, None)
    """
    # Differences of shares go below 0.
    if not SHARES.match(metric) or "_above_" in metric:
        return None
    # Rows without a unit are success rates in percent.
    return 1.0 if unit == "1" else 100.0


def wilson(share: float, n: float, quantile: float = 1.959964) -> tuple[float, float]:
    r"""Wilson's interval of a share of `n` independent trials.

    .. math:: \frac{p + q^2 / 2n \pm q \sqrt{p (1 - p) / n + q^2 / 4 n^2}}{1 + q^2 / n}

    Symbols: :math:`p` is `share`, :math:`q` is `quantile`. It lies within 0 and 1.

    Source: Wilson (1927).

    Example:
        >>> [round(v, 3) for v in wilson(1.0, 20)]
        [0.839, 1.0]
    """
    square = quantile**2 / n
    centre = (share + square / 2) / (1 + square)
    half = quantile / (1 + square) * math.sqrt(share * (1 - share) / n + square / (4 * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def share_interval(
    values: Sequence[float], top: float, *, successes: bool = False
) -> tuple[float, float] | None:
    r"""95 % interval of the mean of shares, one of each independent run.

    Wilson's interval with the number of trials that would give the spread over the runs,
    :math:`n = p (1 - p) / (s^2 / m)` for `m` runs, and Student's quantile of `m - 1` degrees of
    freedom for the normal one: near the middle it is Student's interval of the mean, near 0 and
    `top` it bends and stays inside.

    Args:
        values: of the runs, from 0 to `top`.
        top: 1 or 100.
        successes: the runs are made of trials that succeed or fail; where all have succeeded (or
            failed), each counts as one trial. Other shares without a spread have a point.

    Returns:
        Lower and upper end; None with fewer than two values.
    """
    from scipy import special

    m = len(values)
    if m < 2:
        return None
    shares = [v / top for v in values]
    p = sum(shares) / m
    variance = sum((v - p) ** 2 for v in shares) / (m - 1) / m
    if variance <= 0.0 or not 0.0 < p < 1.0:
        if not successes:
            return values[0], values[0]
        low, high = wilson(min(max(p, 0.0), 1.0), m)
    else:
        quantile = float(special.stdtrit(m - 1, 0.975))
        low, high = wilson(p, p * (1 - p) / variance, quantile)
    return top * low, top * high


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """95 % interval of the median from order statistics; infinite values are allowed.

    The k-th smallest and k-th largest value, with the largest k for which a binomial variable
    of n trials and chance 1/2 falls below k with probability at most 2.5 %; None below six values.
    """
    ordered, n = sorted(values), len(values)
    below, k = 0.0, 0
    while True:
        below += math.comb(n, k) / 2.0**n
        if below > 0.025:
            break
        k += 1
    return (ordered[k - 1], ordered[n - k]) if k else None


def interval(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """The 95 % interval that a page shows for a row of record.

    A share's is worked out from its values (rows that are older than this rule hold Student's
    interval, which can end above 100 %); any other score's is what the row holds.
    """
    top = bound(str(row.get("metric", "")), row.get("unit"))
    held = row.get("ci95")
    values = [v for v in row.get("values") or () if v is not None]
    if top is not None and len(values) > 1:
        successes = bool(SUCCESSES.match(row["metric"]))
        return share_interval(values, top, successes=successes)
    single = COUNTS.match(str(row.get("metric", ""))) and held is None and row.get("n", 0) > 1
    if top is not None and single and row.get("mean") is not None:
        low, high = wilson(row["mean"] / top, row["n"])
        return top * low, top * high
    return None if held is None else (held[0], held[1])
