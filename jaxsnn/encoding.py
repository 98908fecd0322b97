"""From a sensor reading to firing rates of the input groups, and from rates to Poisson spikes.

Seven groups of input neurons: five ultrasonic sensors (left to right), the distance to the target,
the angle to the target. Each reading falls into an interval, each interval has a rate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxsnn._checks import (
    concrete,
    require,
    require_choice,
    require_key,
    require_positive,
    require_whole,
)
from jaxsnn.sensor_intervals import (
    N_DISTANCE,
    N_NEAR,
    N_OCTANT,
    angle_octant,
    angle_region,
    distance_interval,
    near_interval,
    sonar_interval,
)

GROUPS: dict[str, Callable[[int], int]] = {
    "sensor": lambda sonars: sonars + 2,
    "interval": lambda sonars: sonars * N_NEAR + N_DISTANCE + N_OCTANT,
}
"""Input groups by sonars: one for each sensor, or one for each interval of each sensor."""

InputCode = Literal["sensor", "interval"]

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
    require_choice("scheme", scheme, ("reference", "proposed"))
    require_choice("angle_code", angle_code, tuple(ANGLE_CODES))
    reference = scheme == "reference"
    sonar = jnp.array([0.0, 20.0, 40.0] if reference else [0.0, 50.0, 100.0])
    distance = jnp.array([10.0, 20.0, 30.0, 40.0] if reference else [25.0, 50.0, 75.0, 100.0])
    return RateTable(
        sonar=sonar, distance=distance, angle=distance[jnp.array(ANGLE_CODES[angle_code])]
    )


def check_rates(rates: RateTable | Float[Array, "..."], *, dt: float) -> None:
    """Refuse rates that are NaN, negative, or above one spike per step, and a step of no length.

    Raises:
        ValueError: names the rate or the step, and the fix.
    """
    require_positive("dt", dt, "give the step in seconds, 1e-3 for one millisecond")
    for leaf in jax.tree.leaves(rates):
        require_positive("rates", leaf, "give firing rates in Hz", zero=True)
        numbers = concrete(leaf)
        if numbers is not None and numbers.size:
            require(
                bool(numbers.max() * dt <= 1.0),
                f"rates={numbers.max()}: expected at most one spike per step, {1 / dt:g} Hz with "
                f"dt={dt}; lower the rate or dt",
            )


def group_rates(
    table: RateTable,
    sonar: Float[Array, " sonars"],
    distance: Float[Array, ""],
    angle: Float[Array, ""],
) -> Float[Array, " groups"]:
    """Firing rates of the input groups, one for each sensor, for one reading.

    Args:
        table: RateTable.
        sonar: ultrasonic readings [px], left to right.
        distance: to the target [px].
        angle: from the heading to the target [deg], positive to the left.

    Returns:
        Rates [Hz]: sonars, distance, angle.

    Source: Shim (2020), section 2.4.2; `sensor_intervals` says what belongs to which interval.
    """
    return jnp.concatenate(
        [
            table.sonar[sonar_interval(sonar)],
            table.distance[distance_interval(distance)][None],
            table.angle[angle_region(angle)][None],
        ]
    )


def interval_rates(
    rate: float | Float[Array, ""],
    sonar: Float[Array, " sonars"],
    distance: Float[Array, ""],
    angle: Float[Array, ""],
) -> Float[Array, " groups"]:
    """Firing rates of one group for each interval: `rate` where the reading lies, 0 elsewhere.

    A synapse can then speak for one interval of one sensor, where with one rate for each sensor it
    multiplies all of them.

    Args:
        rate: of the group that is on [Hz].
        sonar: ultrasonic readings [px], left to right.
        distance: to the target [px].
        angle: from the heading to the target [deg], positive to the left.

    Returns:
        Rates [Hz]: four intervals of each sonar, four of the distance, eight of the angle.

    Source: ours.
    """
    on = [
        jax.nn.one_hot(near_interval(sonar), N_NEAR, dtype=sonar.dtype).reshape(-1),
        jax.nn.one_hot(distance_interval(distance), N_DISTANCE, dtype=sonar.dtype),
        jax.nn.one_hot(angle_octant(angle), N_OCTANT, dtype=sonar.dtype),
    ]
    return rate * jnp.concatenate(on)


def poisson_spikes(
    rates: Float[Array, " n"] | Sequence[float], n_steps: int, *, dt: float, key: Key[Array, ""]
) -> Float[Array, "t n"]:
    r"""Independent Poisson (Bernoulli per step) spike trains, 0. or 1.

    .. math:: P(\text{spike in a step}) = \text{rate} \cdot dt

    Two draws are made from each 32-bit random word, so probabilities lie on a grid of 2^-16
    (0.015 Hz at 1 ms): half the random numbers, and random numbers are a tenth of a window's work.

    Args:
        rates: per neuron [Hz].
        n_steps: number of steps.
        dt: step [s].
        key: typed PRNG key; its implementation (threefry, rbg) is the caller's choice.

    Returns:
        Spikes, `[n_steps, n]`, of the dtype of `rates`.

    Raises:
        ValueError: a rate is NaN, negative or above one spike per step, or rates are not along one
            axis; `dt` is not positive; a legacy key.

    Example:
        >>> rates, key = jnp.array([0.0, 1000.0]), jax.random.key(0)
        >>> poisson_spikes(rates, 4, dt=1e-3, key=key).sum(0).tolist()
        [0.0, 4.0]
    """
    require_key(key)
    require_whole("n_steps", n_steps, 1, "ask for at least one step")
    rates = jnp.asarray(rates)
    require(
        rates.ndim == 1,
        f"rates=<shape {rates.shape}>: expected [n], one rate per neuron; use jnp.full or vmap",
    )
    check_rates(rates, dt=dt)
    n = rates.shape[0]
    half = (n + 1) // 2
    # The same words as drawn in two dimensions, which take twice as long to compile.
    words = jax.random.bits(key, (n_steps * half,), jnp.uint32).reshape(n_steps, half)
    low, high = words & jnp.uint32(0xFFFF), words >> jnp.uint32(16)
    draws = jnp.concatenate([low, high], axis=1)[:, :n]
    threshold = jnp.round(rates * (dt * 65536.0)).astype(jnp.uint32)
    return (draws < threshold[None, :]).astype(rates.dtype)
