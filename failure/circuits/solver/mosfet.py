"""MOSFET models for the circuit solver: smooth EKV and the square-law level 1.

A transistor here is four-terminal but without body effect (`gamma = 0`), so its current depends on
`v_gs` and `v_ds` alone, and its derivatives sum to zero. Gate capacitances are constants of the
device (saturation value plus overlap). Everything is elementwise over arrays of any shape.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

EPS_OX = 3.9 * 8.8541878128e-12
"""Permittivity of silicon dioxide [F/m]."""

U_T = 0.02585
"""Thermal voltage at 27 degrees Celsius [V]."""

SLOPE = 1.3
"""Subthreshold slope factor n of the EKV model."""

SMOOTH_VDS = 1e-2
"""Width [V] of the smoothed |v_ds| in channel-length modulation."""


class Process(NamedTuple):
    """Constants of one transistor type that do not vary from sample to sample."""

    polarity: float
    """+1 for n channel, -1 for p channel."""
    mobility: float
    """[m^2 / (V s)]"""
    vto: float
    """Nominal threshold voltage, positive for both types [V]."""
    early: float
    """Channel-length modulation times length: lambda = early / L [m/V]."""
    overlap: float
    """Gate-source and gate-drain overlap capacitance per width [F/m]."""
    tox: float
    """Nominal gate oxide thickness [m]."""


NMOS = Process(1.0, 0.04, 0.45, 0.04e-6, 3e-10, 7.5e-9)
PMOS = Process(-1.0, 0.014, 0.50, 0.05e-6, 3e-10, 7.5e-9)


class MosParams(NamedTuple):
    """What the solver needs of each transistor; leaves `[n_mosfets, batch]`."""

    polarity: Float[Array, "..."]
    beta: Float[Array, "..."]
    """Transconductance factor mu C_ox W / L [A/V^2]."""
    vto: Float[Array, "..."]
    """Threshold voltage, positive for both types [V]."""
    lam: Float[Array, "..."]
    """Channel-length modulation [1/V]."""
    cgs: Float[Array, "..."]
    """Gate-source capacitance [F]."""
    cgd: Float[Array, "..."]
    """Gate-drain capacitance [F]."""


def mos_params(
    polarity: Float[Array, "..."],
    mobility: Float[Array, "..."],
    early: Float[Array, "..."],
    overlap: Float[Array, "..."],
    *,
    width: Float[Array, "..."],
    length: Float[Array, "..."],
    vto: Float[Array, "..."],
    tox: Float[Array, "..."],
) -> MosParams:
    r"""Electrical parameters from geometry and process.

    .. math:: \beta = \mu \frac{\epsilon_{ox}}{t_{ox}} \frac{W}{L}, \quad \lambda = \lambda_L / L,
        \quad C_{gs} = \tfrac23 W L \frac{\epsilon_{ox}}{t_{ox}} + C_{ov} W, \quad C_{gd} = C_{ov} W

    Symbols: :math:`\mu` `mobility` [m^2/(V s)]; :math:`\lambda_L` `early` [m/V];
    :math:`C_{ov}` `overlap` [F/m]; :math:`W, L, t_{ox}` [m]; `vto` [V] passes through.

    Returns:
        MosParams with leaves of the common shape of the arguments.
    Source: Shichman and Hodges (1968); capacitances of the saturation region, Meyer (1971).
    Deviation: the capacitances keep their saturation value in every region.
    """
    cox = EPS_OX / tox
    return MosParams(
        polarity=polarity,
        beta=mobility * cox * width / length,
        vto=vto,
        lam=early / length,
        cgs=(2.0 / 3.0) * width * length * cox + overlap * width,
        cgd=overlap * width,
    )


def level1(
    params: MosParams, vgs: Float[Array, "..."], vds: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    r"""Square-law drain current of an n-channel device and its two conductances.

    .. math:: I = \tfrac{\beta}{2} (2 v_{ov} v_{ds} - v_{ds}^2)(1 + \lambda v_{ds}) \;\;(v_{ds} <
        v_{ov}), \qquad I = \tfrac{\beta}{2} v_{ov}^2 (1 + \lambda v_{ds}) \text{ else}

    with :math:`v_{ov} = \max(v_{gs} - V_T, 0)`; for :math:`v_{ds} < 0` source and drain change
    places.

    Args:
        params: MosParams.
        vgs, vds: terminal voltages [V], for a p-channel device with the sign turned.
    Returns:
        (I [A], dI/dv_gs, dI/dv_ds [A/V]).
    Source: Shichman and Hodges (1968), as in SPICE level 1 with gamma = 0.
    """
    reverse = vds < 0.0
    v = jnp.abs(vds)
    # The gate is referred to whichever terminal acts as the source.
    vov = jnp.maximum(jnp.where(reverse, vgs - vds, vgs) - params.vto, 0.0)
    on = (vov > 0.0).astype(vov.dtype)
    clip = jnp.minimum(v, vov)
    clm = 1.0 + params.lam * v
    square = 0.5 * params.beta * clip * (2.0 * vov - clip)
    current = square * clm
    gm = params.beta * clip * clm * on
    gds = jnp.where(v < vov, params.beta * (vov - v) * clm, 0.0) + square * params.lam
    # I(vgs, vds) = -I'(vgs - vds, -vds) when reversed.
    return (
        jnp.where(reverse, -current, current),
        jnp.where(reverse, -gm, gm),
        jnp.where(reverse, gm + gds, gds),
    )


def _softplus(u: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """ln(1 + exp(u)) and its derivative, sharing the exponential, without overflow."""
    e = jnp.exp(-jnp.abs(u))
    r = 1.0 / (1.0 + e)
    return jnp.maximum(u, 0.0) + jnp.log1p(e), jnp.where(u > 0.0, r, e * r)


def ekv(
    params: MosParams, vgs: Float[Array, "..."], vds: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    r"""Smooth EKV drain current of an n-channel device and its two conductances.

    .. math:: I = 2 n^2 \beta U_T^2 \left[F\!\left(\tfrac{v_{gs} - V_T}{n U_T}\right) -
        F\!\left(\tfrac{v_{gd} - V_T}{n U_T}\right)\right] (1 + \lambda |v_{ds}|_\delta), \quad
        F(u) = \ln^2(1 + e^{u/2}), \quad |v|_\delta = \sqrt{v^2 + \delta^2} - \delta

    Symbols: :math:`n` = `SLOPE`; :math:`U_T` thermal voltage; :math:`\delta` = 10 mV. Infinitely
    differentiable, symmetric in source and drain; tends to `level1` far above threshold.

    Args:
        params: MosParams.
        vgs, vds: terminal voltages [V], for a p-channel device with the sign turned.
    Returns:
        (I [A], dI/dv_gs, dI/dv_ds [A/V]).
    Source: Enz, Krummenacher and Vittoz (1995), interpolation function of their Eq. 46.
    Deviation: referred to the source instead of the bulk (no body effect, so that strong inversion
        equals level 1); weak-inversion saturation is then exp(-v_ds / (n U_T)).
    """
    scale = 0.5 / (SLOPE * U_T)
    lf, sf = _softplus((vgs - params.vto) * scale)
    lr, sr = _softplus((vgs - vds - params.vto) * scale)
    i_s = (2.0 * SLOPE**2 * U_T**2) * params.beta
    core = i_s * (lf - lr) * (lf + lr)
    slope = (2.0 * scale) * i_s
    df = slope * lf * sf
    dr = slope * lr * sr
    root = jnp.sqrt(vds * vds + SMOOTH_VDS**2)
    clm = 1.0 + params.lam * (root - SMOOTH_VDS)
    return (
        core * clm,
        (df - dr) * clm,
        dr * clm + core * params.lam * vds / root,
    )


MODELS = {"ekv": ekv, "level1": level1}


def drain_current(
    model: str,
    params: MosParams,
    vd: Float[Array, "..."],
    vg: Float[Array, "..."],
    vs: Float[Array, "..."],
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Current into the drain terminal, its derivatives to the gate and the drain voltage.

    Args:
        model: "ekv" or "level1".
        params: MosParams.
        vd, vg, vs: node voltages [V].
    Returns:
        (I_d [A], dI_d/dv_g, dI_d/dv_d [A/V]); dI_d/dv_s is minus their sum.
    Raises:
        ValueError: unknown model.
    """
    if model not in MODELS:
        raise ValueError(f"model={model!r}: expected one of {', '.join(map(repr, MODELS))}")
    p = params.polarity
    current, gm, gds = MODELS[model](params, p * (vg - vs), p * (vd - vs))
    # The barrier keeps XLA from computing exp and log again for every matrix entry they feed.
    out: tuple[Array, Array, Array] = jax.lax.optimization_barrier((p * current, gm, gds))
    return out
