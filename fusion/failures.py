"""Sensor failures: which channels fail, and what a failed channel reads.

Two pure steps, both inside jit. `draw_mask` draws which channels of which examples fail under a
`Protocol`; `apply_failure` replaces the readings of the failed channels. `corrupt` is both. The
mask depends on the key and the protocol only, so one key gives the same failed channels under every
failure kind, model and run; noise that is drawn once, or anew in every epoch, is a choice of key.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_choice, check_count, check_key, check_number

__all__ = [
    "FAILURE_KINDS",
    "FailureKind",
    "Protocol",
    "apply_failure",
    "corrupt",
    "draw_mask",
    "fixed_failing",
    "generalisation",
    "no_failure",
    "random_failing",
]

FailureKind = Literal["uniform", "gaussian", "zero", "stuck", "drift", "dropout", "gain", "clip"]
FAILURE_KINDS: tuple[FailureKind, ...] = get_args(FailureKind)

# Sizes of the failures that the source does not have; inputs span [-1, 1].
DRIFT_RANGE = (0.5, 2.0)  # offset reached after one whole window
GAIN_RANGE = (2.0, 4.0)  # factor, or one over it
CLIP_RANGE = (0.0, 0.2)  # rail of a saturated channel
BURSTS = 3
BURST_RANGE = (0.1, 0.3)  # length of a burst as a share of the window


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Which channels fail, as static configuration (hashable, so a jit argument may be static).

    Attributes:
        n_channels: K.
        low, high: bounds (inclusive) of the number of failing channels of a corrupted example.
        failing: the channels that fail; empty means drawn anew for each example.
        clean_fraction: share of examples kept clean (a third in the source).
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


def _uniform_in(
    key: Key[Array, ""], shape: tuple[int, ...], bounds: tuple[float, float], dtype: jnp.dtype
) -> Array:
    return jax.random.uniform(key, shape, dtype, bounds[0], bounds[1])


def _random_sign(key: Key[Array, ""], shape: tuple[int, ...], dtype: jnp.dtype) -> Array:
    return jax.random.rademacher(key, shape, dtype)


def _uniform_noise(key: Key[Array, ""], x: Array) -> Array:
    return jax.random.uniform(key, x.shape, x.dtype, -1.0, 1.0)


def _gaussian_noise(key: Key[Array, ""], x: Array) -> Array:
    return jax.random.normal(key, x.shape, x.dtype)


def _zero(key: Key[Array, ""], x: Array) -> Array:
    return jnp.zeros_like(x)


def _stuck(key: Key[Array, ""], x: Array) -> Array:
    n, k, t = x.shape
    if t == 1:
        # A row has no past of its own: the sensor repeats what it read in another row.
        shift = jax.random.randint(key, (1, k), 1, max(n, 2))
        rows = (jnp.arange(n)[:, None] + shift) % n
        return x[rows, jnp.arange(k)[None, :], :]
    frozen_from = jax.random.randint(key, (n, k, 1), 0, t)
    time = jnp.minimum(jnp.arange(t)[None, None, :], frozen_from)
    return jnp.take_along_axis(x, time, axis=2)


def _drift(key: Key[Array, ""], x: Array) -> Array:
    n, k, t = x.shape
    size_key, sign_key, onset_key = jax.random.split(key, 3)
    slope = _uniform_in(size_key, (n, k, 1), DRIFT_RANGE, x.dtype)
    slope = slope * _random_sign(sign_key, (n, k, 1), x.dtype)
    onset = jax.random.uniform(onset_key, (n, k, 1), x.dtype)
    time = (jnp.arange(t, dtype=x.dtype) + 1.0) / t
    return x + slope * jnp.maximum(time[None, None, :] - onset, 0.0)


def _dropout(key: Key[Array, ""], x: Array) -> Array:
    n, k, t = x.shape
    start_key, length_key = jax.random.split(key)
    start = jax.random.uniform(start_key, (n, k, 1, BURSTS), x.dtype)
    length = _uniform_in(length_key, (n, k, 1, BURSTS), BURST_RANGE, x.dtype)
    time = (jnp.arange(t, dtype=x.dtype) + 0.5) / t
    # Bursts wrap around the window's end, so that each sample is equally likely to be lost.
    lost = ((time[None, None, :, None] - start) % 1.0 < length).any(axis=-1)
    return jnp.where(lost, jnp.zeros_like(x), x)


def _gain(key: Key[Array, ""], x: Array) -> Array:
    n, k, _ = x.shape
    size_key, sign_key = jax.random.split(key)
    size = jnp.log(_uniform_in(size_key, (n, k, 1), GAIN_RANGE, x.dtype))
    return x * jnp.exp(size * _random_sign(sign_key, (n, k, 1), x.dtype))


def _clip(key: Key[Array, ""], x: Array) -> Array:
    n, k, _ = x.shape
    rail = _uniform_in(key, (n, k, 1), CLIP_RANGE, x.dtype)
    return jnp.clip(x, -rail, rail)


_FAILED: dict[str, Callable[[Key[Array, ""], Array], Array]] = {
    "uniform": _uniform_noise,
    "gaussian": _gaussian_noise,
    "zero": _zero,
    "stuck": _stuck,
    "drift": _drift,
    "dropout": _dropout,
    "gain": _gain,
    "clip": _clip,
}


def apply_failure(
    x: Float[Array, "n k t"],
    mask: Bool[Array, "n k"],
    kind: FailureKind | str,
    *,
    key: Key[Array, ""],
    severity: float | Float[Array, ""] = 1.0,
) -> Float[Array, "n k t"]:
    r"""Replace the readings of failed channels.

    .. math:: x'_{nkt} = x_{nkt} + m_{nk}\, s\, (f_{nkt}(x) - x_{nkt})

    Symbols: :math:`m` is `mask`; :math:`s` is `severity` in [0, 1]; :math:`f` is the reading of
    a channel that has failed wholly:

    - `uniform`: U(-1, 1), `gaussian`: N(0, 1), independent for each sample (the source's two);
    - `zero`: 0, the middle of the channel's range;
    - `stuck`: the last reading before a time uniform in the window; with T = 1 the reading of
      another row of the batch;
    - `drift`: a ramp from a random onset that would reach 0.5 to 2 (either sign) in a window;
    - `dropout`: three bursts of 10 to 30 % of the window read 0 (49 % of samples on average);
    - `gain`: times 2 to 4, or divided by it;
    - `clip`: saturated at a rail between 0 and 0.2.

    Args:
        x: windows scaled to [-1, 1].
        mask: True where a channel has failed, from `draw_mask`.
        kind: one of `FAILURE_KINDS` (static).
        key: typed PRNG key; only the values depend on it, not the mask.
        severity: share of the way from the clean to the failed reading.

    Returns:
        `[N, K, T]`; clean channels are returned bit for bit.

    Raises:
        ValueError: unknown kind, a severity outside [0, 1], a legacy key.

    Source: Shim (2020), section 3.3.3.1, for uniform and gaussian. Gaussian noise is not clipped,
    so a third of its samples lie outside [-1, 1], as the source's definition has it. The other
    kinds are ours, for robustness scores.
    """
    check_choice("kind", kind, FAILURE_KINDS)
    check_number("severity", severity, 0.0, 1.0, fix="it is a share; 1 is a whole failure")
    check_key(key)
    failed = _FAILED[kind](key, x)
    if not (isinstance(severity, float) and severity == 1.0):
        failed = x + jnp.asarray(severity, x.dtype) * (failed - x)
    return jnp.where(mask[:, :, None], failed, x)


def corrupt(
    protocol: Protocol,
    x: Float[Array, "n k t"],
    kind: FailureKind | str = "uniform",
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
    check_choice("kind", kind, FAILURE_KINDS)
    if x.ndim != 3 or x.shape[1] != protocol.n_channels:
        raise ValueError(
            f"x.shape={tuple(x.shape)}: expected [N, {protocol.n_channels}, T], the protocol's "
            "channels; build the protocol from the channels of this data set"
        )
    check_number("severity", severity, 0.0, 1.0, fix="it is a share; 1 is a whole failure")
    mask_key, value_key = jax.random.split(key)
    mask = draw_mask(protocol, x.shape[0], key=mask_key)
    return apply_failure(x, mask, kind, key=value_key, severity=severity), mask
