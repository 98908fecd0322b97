"""Steps of a fixed size for projected parameters, so that an optimizer's update lands on them.

An optax update is a difference, and in floating point `params + (projected - params)` is not
`projected`: numbers that a projection made equal come out unequal by a rounding error, in the wrong
order half of the time. Projections therefore end on the multiples of a power of two a few units in
the last place wide. Sums and differences of such multiples are exact, so that the order and the
bounds survive the update to the last bit, in every floating type and for every range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fusion.lattice.checks import refusal

# Where both bounds are given they fix the step: two units in the last place of the larger one.
# Otherwise the largest parameter does, and it may shrink in one step by about these factors.
_SPARE_BITS = {"float32": 4, "float64": 4}
_SPARE_BITS_HALF = 2


class Frame(NamedTuple):
    """Where and how finely projected parameters may lie.

    `step`: a power of two; `centre`: taken out before a projection, for its accuracy; `low` and
    `high`: the bounds, rounded inwards to multiples of `step`, or None.
    """

    step: Array
    centre: Array
    low: Array | None
    high: Array | None


def working(values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The values in at least float32, in which projections compute."""
    return values if values.dtype in (jnp.float32, jnp.float64) else values.astype(jnp.float32)


def frame(
    values: Float[Array, "*shape"],
    output_range: tuple[float | None, float | None],
    *,
    axis: int | None = None,
    least: float = 1.0,
) -> Frame:
    r"""The step :math:`2^{k}` for some parameters, and their bounds in multiples of it.

    Args:
        values: parameters before the projection.
        output_range: `(low, high)`, either of which may be None.
        axis: a frame for each slice along this axis, kept as an axis of length 1; one without it.
        least: steps that must fit between the bounds.

    Returns:
        Frame in the type of `working(values)`.

    Raises:
        ValueError: fewer than `least` numbers of the type of `values` lie between the bounds.
    """
    low, high = output_range
    kind = working(values).dtype
    eps = float(jnp.finfo(values.dtype).eps)
    smallest = eps * float(jnp.finfo(values.dtype).tiny)
    if low is not None and high is not None:
        largest = max(abs(low), abs(high))
        step = max(2 * eps * 2.0 ** math.floor(math.log2(largest)), smallest)
        inner = math.ceil(low / step) * step, math.floor(high / step) * step
        if largest > float(jnp.finfo(values.dtype).max) or inner[1] - inner[0] < least * step:
            raise refusal(
                "output_range",
                output_range,
                f"{least:.0f} or more steps of {step:.3g}, as {values.dtype} has them at "
                f"{largest:.3g}",
                "keep the parameters in a wider type, or take the offset out of the range",
            )
        sides = [jnp.asarray(side, kind) for side in inner]
        return Frame(jnp.asarray(step, kind), jnp.asarray(0.5 * sum(inner), kind), *sides)
    wide = working(values)
    keepdims = axis is not None
    given = [abs(side) for side in (low, high) if side is not None]
    size = jnp.maximum(
        jnp.max(jnp.abs(wide), axis=axis, keepdims=keepdims),
        jnp.asarray(max([*given, 1e-30]), kind),
    )
    bits = _SPARE_BITS.get(str(values.dtype), _SPARE_BITS_HALF)
    unit = _power_of_two_below(size) * jnp.asarray(eps * 2.0**bits, kind)
    unit = jnp.maximum(unit, jnp.asarray(smallest, kind))
    return Frame(
        unit,
        jnp.mean(wide, axis=axis, keepdims=keepdims),
        None if low is None else jnp.ceil(jnp.asarray(low, kind) / unit) * unit,
        None if high is None else jnp.floor(jnp.asarray(high, kind) / unit) * unit,
    )


def _power_of_two_below(x: Array) -> Array:
    """The largest power of two that is not above `x`: its exponent without its digits."""
    whole, mask = (
        (jnp.int32, np.int32(0x7F800000))
        if x.dtype == jnp.float32
        else (jnp.int64, np.int64(0x7FF0000000000000))
    )
    bits = lax.bitcast_convert_type(x, whole) & jnp.asarray(mask)
    return lax.bitcast_convert_type(bits, x.dtype)


def snap(values: Float[Array, "*shape"], step: Float[Array, "..."]) -> Float[Array, "*shape"]:
    r"""The nearest multiples of `step`, :math:`s \, \mathrm{round}(v / s)`; keeps every order.

    Example:
        >>> snap(jnp.array([0.3, 0.9]), jnp.array(0.25)).tolist()
        [0.25, 1.0]
    """
    step = jnp.broadcast_to(step, values.shape)
    return jnp.round(values / step) * step


def onto(place: Frame, values: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Whole steps within the bounds of a frame, in the working type; keeps every order."""
    values = snap(working(values), place.step)
    if place.low is not None:
        values = jnp.maximum(values, place.low)
    return values if place.high is None else jnp.minimum(values, place.high)
