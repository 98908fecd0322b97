"""Sensor failures: which channels fail, and what a failed channel reads.

Two pure steps, both inside jit. `draw_mask` draws which channels of which examples fail under a
`Protocol`; `failure_kinds.apply_failure` replaces the readings of the failed channels. `corrupt` is
both. The
mask depends on the key and the protocol only, so one key gives the same failed channels under every
failure kind, model and run; noise that is drawn once, or anew in every epoch, is a choice of key.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_choice, check_count, check_key, check_number
from fusion.failure_kinds import Kinds, apply_failure, check_kinds


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Which channels fail, as static configuration (hashable, so a jit argument may be static).

    Attributes:
        n_channels: K.
        low, high: bounds (inclusive) of the number of failing channels of a corrupted example.
        failing: the channels that fail; empty means drawn anew for each example.
        clean_fraction: share of examples kept clean (a third in the source).

    Raises:
        ValueError, TypeError: counts, channels or a share out of range, by name and value.

    Example:
        >>> Protocol(n_channels=9, low=1, high=3).high
        3
        >>> Protocol(n_channels=3, low=2, high=1)
        Traceback (most recent call last):
        ValueError: high=1: expected a whole number 2..3; raise it
    """

    n_channels: int
    low: int
    high: int
    failing: tuple[int, ...] = ()
    clean_fraction: float = 1.0 / 3.0

    def __post_init__(self) -> None:
        """Check every field before anything is compiled."""
        k = self.n_channels
        check_count("n_channels", k)
        check_count("low", self.low, 0, k)
        check_count("high", self.high, self.low, k)
        check_number("clean_fraction", self.clean_fraction, 0.0, 1.0, fix="1/3 in the source")
        for index, channel in enumerate(self.failing):
            check_count(f"failing[{index}]", channel, 0, k - 1)
        if len(set(self.failing)) != len(self.failing):
            raise ValueError(
                f"failing={self.failing}: expected different channels; leave the repeated ones out"
            )
        if self.failing and not self.low == self.high == len(self.failing):
            raise ValueError(
                f"failing={self.failing}: expected low = high = {len(self.failing)}, not "
                f"{self.low} and {self.high}; use fixed_failing(...)"
            )


def no_failure(channels: Sequence[str]) -> Protocol:
    """All channels of all examples stay clean.

    Returns:
        A protocol whose masks are False.

    Example:
        >>> no_failure(("a", "b")).high
        0
    """
    return Protocol(len(_channels(channels)), 0, 0, clean_fraction=1.0)


def _channels(channels: Sequence[str]) -> list[str]:
    """The names, or ValueError when one occurs twice or there is none."""
    names = list(channels)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        raise ValueError(
            f"channels={names}: expected one or more different names; "
            + (f"rename {', '.join(map(repr, twice))}" if twice else "give at least one")
        )
    return names


def fixed_failing(
    channels: Sequence[str], failing: Sequence[str], *, clean_fraction: float = 1.0 / 3.0
) -> Protocol:
    """The named channels fail in every corrupted example.

    Returns:
        The protocol.

    Raises:
        ValueError: an unknown, repeated or no name; the message lists the known channels.

    Source: Shim (2020), section 3.3.3.2, fixed failing sensor assignment.

    Example:
        >>> fixed_failing(("a", "b", "c"), ("c", "a")).failing
        (0, 2)
    """
    names = _channels(channels)
    for name in failing:
        check_choice("failing", name, names)
    if not failing:
        raise ValueError(f"failing={failing!r}: expected one or more of {names}; name them")
    index = tuple(sorted(names.index(name) for name in failing))
    return Protocol(len(names), len(index), len(index), index, clean_fraction)


def random_failing(
    channels: Sequence[str], n_clean: int, *, clean_fraction: float = 1.0 / 3.0
) -> Protocol:
    """Each corrupted example keeps `n_clean` channels, drawn for this example.

    Returns:
        The protocol.

    Raises:
        TypeError, ValueError: `n_clean` is not a whole number in 0..K-1.

    Source: Shim (2020), section 3.3.3.2, random failing sensor assignment.

    Example:
        >>> random_failing(("a", "b", "c"), n_clean=1).low
        2
    """
    k = len(_channels(channels))
    if n_clean == k:
        raise ValueError(
            f"n_clean={n_clean}: expected a whole number 0..{k - 1} for {k} channels; "
            "no_failure(...) keeps all clean"
        )
    check_count("n_clean", n_clean, 0, k - 1)
    return Protocol(k, k - n_clean, k - n_clean, clean_fraction=clean_fraction)


def generalisation(
    channels: Sequence[str],
    train: tuple[int, int],
    test: tuple[int, int],
    *,
    clean_fraction: float = 1.0 / 3.0,
) -> tuple[Protocol, Protocol]:
    """(a, b)(c, d): a to b failing channels in training examples, c to d in test examples.

    Returns:
        The training and the test protocol.

    Raises:
        ValueError: a range that does not lie in 1..K.

    Source: Shim (2020), section 3.3.3.2 and Tables 3.3 and 3.6, failing sensor generation test.

    Example:
        >>> train, test = generalisation(("a", "b", "c"), (1, 1), (2, 3))
        >>> (train.low, train.high), (test.low, test.high)
        ((1, 1), (2, 3))
    """
    k = len(_channels(channels))
    for part, (low, high) in (("train", train), ("test", test)):
        check_count(f"{part}[0]", low, 1, k)
        check_count(f"{part}[1]", high, low, k)
    return (
        Protocol(k, *train, clean_fraction=clean_fraction),
        Protocol(k, *test, clean_fraction=clean_fraction),
    )


def draw_mask(protocol: Protocol, n: int, *, key: Key[Array, ""]) -> Bool[Array, "n k"]:
    """Draw which channels of which of n examples fail.

    Exactly `round(clean_fraction * n)` examples, at random places, keep all channels. In each other
    example the number of failing channels is uniform on `low .. high`, and each set of that size is
    equally likely (or the fixed set fails).

    Returns:
        `[n, K]`, True where a channel has failed.
    """
    check_key(key)
    k = protocol.n_channels
    row_key, count_key, channel_key = jax.random.split(key, 3)
    n_clean_rows = round(protocol.clean_fraction * n)
    order = jnp.argsort(jax.random.bits(row_key, (n,)))
    corrupted = jnp.zeros(n, bool).at[order[n_clean_rows:]].set(True)
    if protocol.failing:
        fails = jnp.zeros(k, bool).at[jnp.array(protocol.failing)].set(True)
        return corrupted[:, None] & fails[None, :]
    count = jax.random.randint(count_key, (n, 1), protocol.low, protocol.high + 1)
    # Rank of each channel among the K of its example, by comparison: for few channels much cheaper
    # than sorting every row. Equal scores rank by position, so that a rank never occurs twice.
    score = jax.random.bits(channel_key, (n, k))
    mine, other = score[:, :, None], score[:, None, :]
    earlier = jnp.tri(k, k=-1, dtype=bool)[None, :, :]
    rank = jnp.sum((other < mine) | ((other == mine) & earlier), axis=2, dtype=jnp.int32)
    return corrupted[:, None] & (rank < count)


def corrupt(
    protocol: Protocol,
    x: Float[Array, "n k t"],
    kind: Kinds = "uniform",
    *,
    key: Key[Array, ""],
    severity: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, "n k t"], Bool[Array, "n k"]]:
    """Draw the failing channels of every example and replace their readings.

    Args:
        protocol: which channels fail (static).
        x: windows scaled to [-1, 1].
        kind: how they fail (static), see `apply_failure`.
        key: one key gives one corruption; the mask is the same for all kinds and severities.
        severity: see `apply_failure`.

    Returns:
        (`[N, K, T]` corrupted windows, `[N, K]` mask of failed channels).

    Raises:
        ValueError: unknown kind, or a protocol for another number of channels.

    Example:
        >>> x = jnp.full((6, 4, 1), 0.5)
        >>> y, mask = corrupt(random_failing("abcd", n_clean=1), x, "zero", key=jax.random.key(0))
        >>> int(mask.any(axis=1).sum()), int(mask.sum()), float(y.sum())
        (4, 12, 6.0)
    """
    check_key(key)
    check_kinds("kind", kind)
    if x.ndim != 3 or x.shape[1] != protocol.n_channels:
        raise ValueError(
            f"x.shape={tuple(x.shape)}: expected [N, {protocol.n_channels}, T], the protocol's "
            "channels; build the protocol from the channels of this data set"
        )
    check_number("severity", severity, 0.0, 1.0, fix="it is a share; 1 is a whole failure")
    mask_key, value_key = jax.random.split(key)
    mask = draw_mask(protocol, x.shape[0], key=mask_key)
    return apply_failure(x, mask, kind, key=value_key, severity=severity), mask
