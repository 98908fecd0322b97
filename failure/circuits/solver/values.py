"""Element values of a batch of samples, and the values as drawn."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from failure.circuits.solver.mosfet import MosParams, mos_params
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Inductor,
    Load,
    Mosfet,
    Resistor,
    Switch,
    VoltageSource,
)
from failure.circuits.solver.system import System


class Values(NamedTuple):
    """Element values; leaves `[n_elements_of_that_kind, batch]`, or `[..., 1]` when common."""

    mos: MosParams
    ohms: Float[Array, "r b"]
    farads: Float[Array, "c b"]
    henries: Float[Array, "l b"]
    volts: Float[Array, "v b"]
    amps: Float[Array, "i b"]
    load: Float[Array, "o b"]
    control: Float[Array, "s b"]


def nominal_values(system: System) -> Values:
    """Values of the netlist as drawn, leaves `[n, 1]`, float64 inside `jax.enable_x64`."""

    def column(kind: type, attribute: str) -> Array:
        return jnp.array([getattr(e, attribute) for e in system.netlist.of(kind)]).reshape(-1, 1)

    def process(attribute: str) -> Array:
        return jnp.array(
            [getattr(e.process, attribute) for e in system.netlist.of(Mosfet)]
        ).reshape(-1, 1)

    mos = mos_params(
        process("polarity"),
        process("mobility"),
        process("early"),
        process("overlap"),
        width=column(Mosfet, "width"),
        length=column(Mosfet, "length"),
        vto=process("vto"),
        tox=process("tox"),
    )
    return Values(
        mos=mos,
        ohms=column(Resistor, "ohms"),
        farads=column(Capacitor, "farads"),
        henries=column(Inductor, "henries"),
        volts=column(VoltageSource, "volts"),
        amps=column(CurrentSource, "amps"),
        load=column(Load, "amps"),
        control=column(Switch, "control"),
    )


def batch_size(values: Values) -> int:
    """The common length of the last axis."""
    leaves = [*values.mos, *values[1:]]
    return max(leaf.shape[-1] for leaf in leaves if leaf.shape[0])
