"""Buck converter of 22 transistors under variation of channel length and width.

Transistor level where transistors decide: the error amplifier by DC, the comparator, drivers and
power switches by one short transient through both edges. What these give (transconductance,
offset, delays, on resistances) goes into the cycle map of `cycle`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from failure.circuits.buck.blocks import amplifier, edges
from failure.circuits.buck.cycle import Stage, pwm_cycle, stage_matrix
from failure.circuits.buck.schematic import (
    AMPLIFIER_MOSFETS,
    C_ZERO,
    CAPACITANCE,
    INDUCTANCE,
    LOAD_HEAVY,
    LOAD_LIGHT,
    MOSFETS,
    N_AFTER,
    N_BEFORE,
    PERIOD,
    R_COIL,
    R_COMP,
    R_ESR,
    R_ZERO,
    RAMP_LOW,
    RAMP_RISE,
    RAMP_SLOPE,
    RAMP_TOP,
    V_COMP,
    V_DD,
    V_REF,
)
from failure.circuits.protocol import Spec
from failure.status import Status

Load = float | Float[Array, ""]
"""A load current [A]."""

SPECS = (
    Spec("output_accuracy", "V", "max", "distance of the mean output from the reference, 0.2 A"),
    Spec("overshoot", "V", "max", "peak of the output after the load step, over the reference"),
)


def solve_dcdc(
    x: Float[Array, "d b"],
    *,
    model: str = "ekv",
    refine: int = 1,
    points: int = 8,
    dense: bool = False,
    loads: tuple[Load, Load] = (LOAD_HEAVY, LOAD_LIGHT),
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma, transistor-major (length, width).
        model: MOSFET model.
        refine: divides the time steps of the edge transient.
        points: output samples in each half period.
        dense: a program that is quicker to compile and slower to run, for gradients.
        loads: before and after the step [A].
    Returns:
        (specs `[2, b]` in the order of `SPECS`, status `[b]`).
    """
    batch = x.shape[-1]
    u = x.reshape(len(MOSFETS), 2, batch)
    n_amp = len(AMPLIFIER_MOSFETS)
    amp = amplifier(u[:n_amp], model=model, dense=dense)
    edge = edges(u[n_amp:], model=model, refine=refine, dense=dense, load=loads[0])
    one = jnp.ones((batch,), x.dtype)
    stage = Stage(
        INDUCTANCE * one, CAPACITANCE * one, R_COIL * one, R_ESR * one, R_COMP * one,
        R_ZERO * one, C_ZERO * one, amp.gm, amp.go, amp.i_offset, V_REF * one, V_COMP * one,
    )  # fmt: skip
    # The period runs from fall to fall; the ramp starts this long after the fall.
    t_ramp = PERIOD - (RAMP_RISE + RAMP_TOP + edge.fall)

    def periods(carry: tuple, load: Load, count: int) -> tuple[tuple, tuple]:
        low = stage_matrix(stage, 0.0 * one, edge.r_low, load * one)
        high = stage_matrix(stage, V_DD * one, edge.r_high, load * one)

        def one_period(carry: tuple, _: None) -> tuple[tuple, tuple]:
            state, t = carry
            state, t, peak = pwm_cycle(
                low, high, state, t,
                ramp_start=RAMP_LOW * one, ramp_slope=RAMP_SLOPE, t_ramp=t_ramp,
                delay=edge.rise, period=PERIOD, points=points,
            )  # fmt: skip
            return (state, t), (state[3], peak)

        return jax.lax.scan(one_period, carry, None, length=count)

    start = jnp.stack([loads[0] * one, V_REF * one, (V_COMP - V_REF) * one, 0.0 * one, one])
    carry, (integral, _) = periods((start, 0.5 * PERIOD * one), loads[0], N_BEFORE)
    mean = (integral[-1] - integral[-1 - 8]) / (8 * PERIOD)
    _, (_, peak) = periods(carry, loads[1], N_AFTER)
    specs = jnp.stack([jnp.abs(mean - V_REF), jnp.max(peak, axis=0) - V_REF])
    status = jnp.maximum(amp.status, edge.status)
    return specs, jnp.where(jnp.all(jnp.isfinite(specs), axis=0), status, Status.NOT_FINITE)
