"""From a sensor reading to firing rates of the input groups, and from rates to Poisson spikes.

Seven groups of input neurons: five ultrasonic sensors (left to right), the distance to the target,
the angle to the target. Each reading falls into an interval, each interval has a rate.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxsnn._checks import concrete, require, require_positive

__all__ = [
    "ANGLE_CODES",
    "N_GROUPS",
    "RateTable",
    "angle_region",
    "check_rates",
    "group_rates",
    "poisson_spikes",
    "rate_table",
]

N_GROUPS = 7

AngleCode = Literal["region", "listed", "ring"]

# Which of the four rates (0 = lowest) a target in region 1, 2, 3, 4 gets. The text says that the
# scheme of the distance sensor is adopted for four intervals and leaves their order to a lost
# drawing: "region" is the order of the region numbers, "listed" that of the sentence (north, south,
# west, east). "ring" is not in the source: east, north, west ascend, so that the two sides are at
# the two ends, and south shares the side of the larger turn.
ANGLE_CODES: dict[str, tuple[int, int, int, int]] = {
    "region": (0, 1, 2, 3),
    "listed": (0, 3, 1, 2),
    "ring": (1, 0, 3, 2),
}


class RateTable(NamedTuple):
    """Firing rate of each interval [Hz].

    Attributes:
        sonar: intervals 0-99, 100-199 and 200-300 pixels, `[3]`.
        distance: four equal intervals of 0-800 pixels, `[4]`.
        angle: target in region 1 (ahead), 2 (right), 3 (behind), 4 (left), `[4]`.
    """

    sonar: Float[Array, "3"]
    distance: Float[Array, "4"]
    angle: Float[Array, "4"]


def rate_table(
    scheme: Literal["reference", "proposed"], angle_code: AngleCode = "region"
) -> RateTable:
    """The rates of section 2.4.2: up to 40 Hz in the reference network, 100 Hz in the proposed one.

    Args:
        scheme: "reference" (S1, S2) or "proposed" (S3, S4).
        angle_code: which interval of the angle gets which of the four rates, see `ANGLE_CODES`.

    Source: Shim (2020), section 2.4.2.

    Example:
        >>> rate_table("proposed").sonar.tolist()
        [0.0, 50.0, 100.0]
    """
    if scheme not in ("reference", "proposed"):
        raise ValueError(f"scheme = {scheme!r}: expected 'reference' or 'proposed'")
    if angle_code not in ANGLE_CODES:
        raise ValueError(f"angle_code = {angle_code!r}: expected one of {sorted(ANGLE_CODES)}")
    reference = scheme == "reference"
    sonar = jnp.array([0.0, 20.0, 40.0] if reference else [0.0, 50.0, 100.0])
    distance = jnp.array([10.0, 20.0, 30.0, 40.0] if reference else [25.0, 50.0, 75.0, 100.0])
    return RateTable(
        sonar=sonar, distance=distance, angle=distance[jnp.array(ANGLE_CODES[angle_code])]
    )


def check_rates(rates: RateTable | Float[Array, "..."], *, dt: float) -> None:
    """Refuse rates that are NaN, negative, or above one spike per step.

    Raises:
        ValueError: names the rate and the fix.
    """
    for leaf in jax.tree.leaves(rates):
        require_positive("firing rate", leaf, "give rates in Hz", zero=True)
        numbers = concrete(leaf)
        if numbers is not None:
            require(
                bool(numbers.max() * dt <= 1.0),
                f"firing rate = {numbers.max()} Hz is above one spike per step of {dt} s; "
                "lower it or dt",
            )


def angle_region(angle: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Region of Figure 2.4 that holds the target: 0 ahead, 1 right, 2 behind, 3 left.

    Quarter circles centred on the heading; regions 1 to 4 of the source, clockwise, less one.

    Args:
        angle: from the heading to the target [deg], positive to the left, in (-180, 180].

    Example:
        >>> angle_region(jnp.array([0.0, -90.0, 180.0, 90.0])).tolist()
        [0, 1, 2, 3]
    """
    region = jnp.where(angle > 0, 3, 1)
    region = jnp.where(jnp.abs(angle) <= 45.0, 0, region)
    return jnp.where(jnp.abs(angle) > 135.0, 2, region)


def group_rates(
    table: RateTable,
    sonar: Float[Array, "5"],
    distance: Float[Array, ""],
    angle: Float[Array, ""],
) -> Float[Array, "7"]:
    """Firing rates of the seven input groups for one reading.

    Args:
        table: RateTable.
        sonar: ultrasonic readings [px], left to right.
        distance: to the target [px].
        angle: from the heading to the target [deg], positive to the left.

    Returns:
        Rates [Hz]: five sonars, distance, angle.

    Source:
        Shim (2020), section 2.4.2. A reading between the printed integer bounds (99 to 100) belongs
        to the lower interval.
    """
    near = jnp.clip(jnp.floor(sonar / 100.0), 0, 2).astype(jnp.int32)
    far = jnp.clip(jnp.floor(distance / 200.0), 0, 3).astype(jnp.int32)
    return jnp.concatenate(
        [table.sonar[near], table.distance[far][None], table.angle[angle_region(angle)][None]]
    )


def poisson_spikes(
    key: Key[Array, ""], rates: Float[Array, " n"], n_steps: int, *, dt: float
) -> Float[Array, "t n"]:
    r"""Independent Poisson (Bernoulli per step) spike trains, 0. or 1.

    .. math:: P(\text{spike in a step}) = \text{rate} \cdot dt

    Two draws are made from each 32-bit random word, so probabilities lie on a grid of 2^-16
    (0.015 Hz at 1 ms): half the random numbers, and random numbers are a tenth of a window's work.

    Args:
        key: typed PRNG key; its implementation (threefry, rbg) is the caller's choice.
        rates: per neuron [Hz].
        n_steps: number of steps.
        dt: step [s].

    Returns:
        Spikes, `[n_steps, n]` float32.

    Example:
        >>> poisson_spikes(jax.random.key(0), jnp.array([0.0, 1000.0]), 4, dt=1e-3).sum(0).tolist()
        [0.0, 4.0]
    """
    n = rates.shape[0]
    words = jax.random.bits(key, (n_steps, (n + 1) // 2), jnp.uint32)
    low, high = words & jnp.uint32(0xFFFF), words >> jnp.uint32(16)
    draws = jnp.concatenate([low, high], axis=1)[:, :n]
    threshold = jnp.round(rates * (dt * 65536.0)).astype(jnp.uint32)
    return (draws < threshold[None, :]).astype(jnp.float32)
