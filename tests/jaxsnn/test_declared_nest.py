"""Neurons of `jaxsnn.declared` against the recording of NEST (tests/reference)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import declared as d

REFERENCE = Path(__file__).resolve().parent.parent / "reference" / "snn_nest.py"
_SPEC = importlib.util.spec_from_file_location("snn_nest", REFERENCE)
RECIPE = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(RECIPE)
TIGHT = 1e-8
"""Of the range of a potential; both sides compute in float64."""
HALF = RECIPE.STEPS // RECIPE.EVERY // 2
"""Potentials are compared so far: Izhikevich's neuron magnifies what was rounded."""


@pytest.fixture(scope="module")
def data(golden):
    return dict(np.load(golden / "snn_nest.npz"))


def simulate(neuron, currents, dt):
    """Spikes and every fifth potential under held currents, in float64."""
    with jax.enable_x64(True):
        net = d.declare({"cells": d.Population(len(currents), neuron=neuron)}, {}, dt=dt)
        held = jnp.broadcast_to(jnp.asarray(currents), (RECIPE.STEPS, len(currents)))

        @jax.jit
        def run(state, held):
            inputs = {"cells": held}
            return d.run(
                net, d.constants(net), state, inputs, watch=lambda s: s.membranes["cells"].v
            )

        _, spikes, v = run(d.init(jax.random.key(0), net), held)
        return np.asarray(spikes["cells"]), np.asarray(v)[:: RECIPE.EVERY]


def check(data, name, spikes, v):
    v, want = v[:HALF], data[f"{name}_v"][:HALF]
    assert spikes.sum() > 5
    np.testing.assert_array_equal(spikes, data[f"{name}_spikes"], err_msg=name)
    assert np.abs(v - want).max() < TIGHT * np.ptp(want), name


def test_the_exact_lif_neuron_is_nest_s(data):
    neuron = d.LIF(**RECIPE.LIF, t_ref=RECIPE.T_REF, method="exact")
    check(data, "lif", *simulate(neuron, RECIPE.LIF_CURRENT, RECIPE.LIF_DT))


@pytest.mark.parametrize("method", ["euler", "paper"])
@pytest.mark.parametrize("cell", sorted(RECIPE.CELLS))
def test_izhikevich_s_neuron_is_nest_s(data, cell, method):
    neuron = d.Izhikevich(**RECIPE.CELLS[cell], method=method)
    check(data, f"{cell}_{method}", *simulate(neuron, RECIPE.CELL_CURRENT, RECIPE.CELL_DT))


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method='heun'"):
        d.Izhikevich(method="heun").check(1e-3)
