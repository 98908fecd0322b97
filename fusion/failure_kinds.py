"""What a failed sensor reads: noise, nothing, the last value, a drift, bursts, a gain, a rail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_choice, check_key, check_number

FailureKind = Literal["uniform", "gaussian", "zero", "stuck", "drift", "dropout", "gain", "clip"]
FAILURE_KINDS: tuple[FailureKind, ...] = get_args(FailureKind)
Kinds = FailureKind | str | tuple[str, ...]
"""One kind for all examples, or several of which each example gets one."""

# Sizes of the failures that the source does not have; inputs span [-1, 1].
DRIFT_RANGE = (0.5, 2.0)  # offset reached after one whole window
GAIN_RANGE = (2.0, 4.0)  # factor, or one over it
CLIP_RANGE = (0.0, 0.2)  # rail of a saturated channel
BURSTS = 3
BURST_RANGE = (0.1, 0.3)  # length of a burst as a share of the window


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


def check_kinds(name: str, kinds: Kinds | None) -> None:
    """Refuse what is neither a kind nor a mixture of different kinds."""
    if not isinstance(kinds, tuple):
        check_choice(name, kinds, FAILURE_KINDS)
        return
    for kind in kinds:
        check_choice(name, kind, FAILURE_KINDS)
    if not kinds or len(set(kinds)) < len(kinds):
        raise ValueError(
            f"{name}={kinds}: expected one or more different kinds; leave the repeated ones out"
        )


def apply_failure(
    x: Float[Array, "n k t"],
    mask: Bool[Array, "n k"],
    kind: Kinds,
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
        kind: one of `FAILURE_KINDS`, or several of which each example draws one (static).
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
    check_kinds("kind", kind)
    check_number("severity", severity, 0.0, 1.0, fix="it is a share; 1 is a whole failure")
    check_key(key)
    if isinstance(kind, tuple):
        draw_key, *keys = jax.random.split(key, 1 + len(kind))
        drawn = jax.random.randint(draw_key, x.shape[:1], 0, len(kind))[:, None, None]
        failed = x
        for number, (one, one_key) in enumerate(zip(kind, keys, strict=True)):
            failed = jnp.where(drawn == number, _FAILED[one](one_key, x), failed)
    else:
        failed = _FAILED[kind](key, x)
    if not (isinstance(severity, float) and severity == 1.0):
        failed = x + jnp.asarray(severity, x.dtype) * (failed - x)
    return jnp.where(mask[:, :, None], failed, x)
