"""Event-driven cycle map of a switching converter: linear circuits joined at switching instants.

Between two events the power stage and the compensator are linear with constant inputs, so a state
moves by a matrix exponential, exactly; only the trip time of the comparator needs iteration. The
batch is last throughout.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SQUARINGS = 6
_TERMS = 8


def _matmul(a: Float[Array, "n n b"], c: Float[Array, "n n b"]) -> Float[Array, "n n b"]:
    return jnp.sum(a[:, :, None] * c[None], axis=1)


def _apply(a: Float[Array, "n n b"], x: Float[Array, "n b"]) -> Float[Array, "n b"]:
    return jnp.sum(a * x[None], axis=1)


def expm(a: Float[Array, "n n b"]) -> Float[Array, "n n b"]:
    r"""Matrix exponential of a batch by scaling and squaring, batch last.

    .. math:: e^A = (T_8(A / 2^6))^{64}

    with :math:`T_8` the Taylor polynomial of degree 8: its error is below 1e-11 while the norm of
    A stays below 10, which one period of the converter does.

    Args:
        a: matrices.
    Returns:
        Their exponentials.
    Source: Moler and Van Loan (2003), method 3.
    """
    small = a / 2.0**_SQUARINGS
    eye = jnp.broadcast_to(jnp.eye(a.shape[0], dtype=a.dtype)[:, :, None], a.shape)
    out = eye + small / _TERMS
    for k in range(_TERMS - 1, 0, -1):
        out = eye + _matmul(small, out) / k
    for _ in range(_SQUARINGS):
        out = _matmul(out, out)
    return out


class Stage(NamedTuple):
    """Linear buck stage with its compensator; leaves `[b]`.

    State: inductor current, capacitor voltage, compensator capacitor voltage, running integral of
    the output voltage, and the constant 1.
    """

    inductance: Float[Array, "b"]
    capacitance: Float[Array, "b"]
    r_coil: Float[Array, "b"]
    r_esr: Float[Array, "b"]
    r_comp: Float[Array, "b"]
    """From the compensator node to the reference [ohm]."""
    r_zero: Float[Array, "b"]
    c_zero: Float[Array, "b"]
    """From the output through r_zero and c_zero to the compensator node."""
    gm: Float[Array, "b"]
    """Transconductance of the error amplifier, output over feedback [S]."""
    go: Float[Array, "b"]
    """Its output conductance [S]."""
    i_offset: Float[Array, "b"]
    """Its output current with the feedback at the reference and the output at `v_comp` [A]."""
    v_ref: Float[Array, "b"]
    v_comp: Float[Array, "b"]


def stage_matrix(
    p: Stage, v_switch: Float[Array, "b"], r_switch: Float[Array, "b"], load: Float[Array, "b"]
) -> tuple[Float[Array, "5 5 b"], Float[Array, "5 b"], Float[Array, "5 b"]]:
    r"""Generator A of the state and the rows that read the output and the comparator input.

    .. math:: L \dot i = v_s - (R_s + R_L) i - v_o, \quad C \dot v_C = i - I, \quad
        v_o = v_C + R_e (i - I), \quad
        0 = \tfrac{v_c - V_{ref}}{R_c} + g_o (v_c - v_{c0}) - g_m (v_o - V_{ref}) - I_0 +
        \tfrac{v_c - v_z - v_o}{R_z}, \quad C_z \dot v_z = \tfrac{v_c - v_z - v_o}{R_z}

    Args:
        p: Stage.
        v_switch: open voltage :math:`v_s` of the switching node [V].
        r_switch: on resistance :math:`R_s` of the switch that conducts [ohm].
        load: load current I [A].
    Returns:
        (A with :math:`\dot x = A x`, row of :math:`v_o`, row of :math:`v_c`).
    """
    zero, one = jnp.zeros_like(load), jnp.ones_like(load)
    out = jnp.stack([p.r_esr, one, zero, zero, -p.r_esr * load])
    unit_z = jnp.stack([zero, zero, one, zero, zero])
    unit_1 = jnp.stack([zero, zero, zero, zero, one])
    unit_i = jnp.stack([one, zero, zero, zero, zero])
    g = 1.0 / p.r_comp + p.go + 1.0 / p.r_zero
    fixed = p.v_ref / p.r_comp + p.go * p.v_comp + p.i_offset - p.gm * p.v_ref
    comp = (
        out * ((p.gm + 1.0 / p.r_zero) / g)[None]
        + unit_z * (1.0 / (p.r_zero * g))[None]
        + unit_1 * (fixed / g)[None]
    )
    drop = unit_i * (r_switch + p.r_coil)[None]
    coil = (unit_1 * v_switch[None] - drop - out) / p.inductance[None]
    cap = (unit_i - unit_1 * load[None]) / p.capacitance[None]
    zero_row = (comp - unit_z - out) / (p.r_zero * p.c_zero)[None]
    return jnp.stack([coil, cap, zero_row, out, jnp.zeros_like(out)]), out, comp


def walk(
    a: Float[Array, "n n b"],
    row: Float[Array, "n b"],
    x: Float[Array, "n b"],
    length: Float[Array, "b"],
    *,
    points: int,
) -> tuple[Float[Array, "n b"], Float[Array, "b"]]:
    """Move the state over a segment and find the largest output on the way.

    Args:
        a: generator of the segment.
        row: reads the output.
        x: state at the start.
        length: of the segment [s].
        points: samples of the output; between two of them the vertex of a parabola counts.
    Returns:
        (state at the end, largest output).
    """
    step = expm(a * (length / points)[None, None])
    peak = jnp.sum(row * x, axis=0)
    for _ in range(points):
        new = _apply(step, x)
        v0, v1 = jnp.sum(row * x, axis=0), jnp.sum(row * new, axis=0)
        h = length / points
        s0 = jnp.sum(row * _apply(a, x), axis=0) * h
        s1 = jnp.sum(row * _apply(a, new), axis=0) * h
        # Vertex of the parabola with these end slopes, where it lies inside the step.
        inside = (s0 > 0.0) & (s1 < 0.0)
        at = s0 / jnp.where(inside, s0 - s1, 1.0)
        vertex = v0 + 0.5 * s0 * at
        peak = jnp.maximum(peak, jnp.maximum(v1, jnp.where(inside, vertex, v1)))
        x = new
    return x, peak


def until(
    a: Float[Array, "n n b"],
    row: Float[Array, "n b"],
    x: Float[Array, "n b"],
    t_guess: Float[Array, "b"],
    *,
    iterations: int = 4,
) -> Float[Array, "b"]:
    """Time at which `row` times the state passes zero, by Newton on the exact trajectory.

    Args:
        a: generator.
        row: what passes zero; falling or rising steadily.
        x: state at the start.
        t_guess: start [s].
        iterations: Newton steps.
    Returns:
        Time [s], not below zero.
    """
    t = t_guess
    for _ in range(iterations):
        here = _apply(expm(a * t[None, None]), x)
        rate = jnp.sum(row * _apply(a, here), axis=0)
        t = jnp.maximum(t - jnp.sum(row * here, axis=0) / rate, 0.0)
    return t


def pwm_cycle(
    low: tuple[Array, Array, Array],
    high: tuple[Array, Array, Array],
    x: Float[Array, "5 b"],
    t_guess: Float[Array, "b"],
    *,
    ramp_start: Float[Array, "b"],
    ramp_slope: float,
    t_ramp: Float[Array, "b"],
    delay: Float[Array, "b"],
    period: float,
    points: int = 8,
    iterations: int = 3,
) -> tuple[Float[Array, "5 b"], Float[Array, "b"], Float[Array, "b"]]:
    """One period from the fall of the switching node to its next fall.

    The node rises `delay` after the compensator voltage meets the ramp, `ramp_start + ramp_slope
    (t - t_ramp)`; the trip time is found by Newton on the exact trajectory.

    Args:
        low, high: `stage_matrix` of the two halves.
        x: state at the fall.
        t_guess: trip time of the last period [s].
        ramp_start, ramp_slope, t_ramp: the ramp [V], [V/s], and where it starts [s].
        delay: from the meeting to the rise of the switching node [s].
        period: [s].
        points: samples of the output in each half.
        iterations: Newton steps.
    Returns:
        (state at the next fall, trip time, largest output of the period).
    """
    a_low, out_low, comp_row = low
    a_high, out_high, _ = high
    t = t_guess
    # Floor and ceiling of the duty cycle: the ramp ends, and a trip cannot lie before the fall.
    least, most = 0.02 * period, 0.98 * period
    for _ in range(iterations):
        here = _apply(expm(a_low * t[None, None]), x)
        gap = jnp.sum(comp_row * here, axis=0) - (ramp_start + ramp_slope * (t - t_ramp))
        rate = jnp.sum(comp_row * _apply(a_low, here), axis=0) - ramp_slope
        t = jnp.clip(t - gap / jnp.minimum(rate, -0.2 * ramp_slope), least, most)
    rise = jnp.clip(t + delay, least, most)

    x, first = walk(a_low, out_low, x, rise, points=points)
    x, second = walk(a_high, out_high, x, period - rise, points=points)
    return x, jax.lax.stop_gradient(t), jnp.maximum(first, second)
