"""The LDO regulator by ngspice: the same samples, the same specifications."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from failure.circuits.ldo.schematic import (
    I_HEAVY,
    I_LIGHT,
    KNEE,
    NETLIST,
    QUANTITIES,
    T_END,
    T_RISE,
    T_STEP,
    variation,
)
from failure.circuits.solver import ngspice
from failure.circuits.solver.decks import sample_decks
from failure.circuits.solver.system import compile_netlist

_STEP = ((0.0, I_LIGHT), (T_STEP, I_LIGHT), (T_STEP + T_RISE, I_HEAVY), (1.0, I_HEAVY))


def ldo_decks(
    x: np.ndarray, *, model: str = "level1", max_step: float = 0.1e-9, reltol: float = 1e-6
) -> list[str]:
    """ngspice input files of samples `x [n, 60]` in sigma.

    Args:
        x: samples.
        model: "level1" (ngspice's own) or "ekv" (behavioural sources).
        max_step: largest time step [s].
        reltol: relative tolerance of ngspice.
    Returns:
        One text per sample; each prints `iq`, `undershoot`, `regulation`, `vlight`, `vheavy`.
    """
    with jax.enable_x64(True):
        values = variation(compile_netlist(NETLIST, "level1"), jnp.asarray(x.T, jnp.float64))
    values = jax.tree.map(np.asarray, values)
    # Length alone of what a transistor's drawing says is varied.
    length = 1.0 + QUANTITIES[0][2] * np.asarray(x, np.float64).reshape(len(x), -1, 3)[:, :, 0].T
    control = [
        "op",
        f"let iq=-i(v_vin)-{I_LIGHT!r}*tanh(v(out)/{KNEE!r})",
        "let vlight=v(out)",
        "print iq",
        "print vlight",
        f"tran {max_step!r} {T_END!r} 0 {max_step!r}",
        f"meas tran vmin min v(out) from={T_STEP!r} to={T_END!r}",
        f"meas tran vstart find v(out) at={0.9 * T_STEP!r}",
        "let undershoot=vstart-vmin",
        "print undershoot",
        f"alter V_Bload dc={I_HEAVY!r}",
        "op",
        "let vheavy=v(out)",
        "print vheavy",
    ]
    return sample_decks(
        "LDO", NETLIST, values, control,
        stretch=np.stack([np.ones_like(length), length]),
        model=model,
        waves={"Bload": _STEP},
        options=f"reltol={reltol!r} abstol=1e-15 vntol=1e-9",
    )  # fmt: skip


def ldo_reference(
    x: np.ndarray,
    *,
    model: str = "level1",
    workers: int = 2,
    timeout: float = 60.0,
    max_step: float = 0.1e-9,
) -> tuple[np.ndarray, np.ndarray]:
    """Specifications of samples by ngspice.

    Args:
        x: `[n, 60]` in sigma.
        model: "level1" or "ekv".
        workers: processes at a time.
        timeout: limit of each [s].
        max_step: largest time step [s].
    Returns:
        (specs `[n, 3]` as `ldo.SPECS`, status `[n]`).
    Raises:
        NgspiceError: not installed.
    """
    decks = ldo_decks(np.asarray(x, np.float64), model=model, max_step=max_step)
    numbers, status = ngspice.run_many(
        decks, ("iq", "undershoot", "vlight", "vheavy"), workers=workers, timeout=timeout
    )
    iq, undershoot, light, heavy = numbers.T
    return np.stack([iq, undershoot, 100.0 * (light - heavy) / light], axis=1), status
