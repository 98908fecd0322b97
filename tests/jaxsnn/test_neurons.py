"""LIF: closed forms, order of operations, bad input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn.neurons import LIFParams, LIFState, check_lif, lif_init, lif_scan, lif_step

DT = 1e-3


def test_leak_is_the_euler_geometric_series():
    params = LIFParams(v_rest=-65.0, v_reset=-70.0, v_th=-50.0)
    state = LIFState(v=jnp.array([-55.0, -75.0]), refractory=jnp.zeros(2))
    _, spikes, v = lif_scan(params, state, jnp.zeros((50, 2)), dt=DT)
    factor = (1 - DT / params.tau_m) ** np.arange(1, 51)
    want = -65.0 + factor[:, None] * np.array([10.0, -10.0])
    np.testing.assert_allclose(v, want, rtol=1e-5)
    assert not spikes.any()


def test_euler_converges_with_first_order():
    def error(dt: float) -> float:
        params = LIFParams(v_th=100.0)
        state = LIFState(v=jnp.array([0.0]), refractory=jnp.zeros(1))
        for _ in range(round(20e-3 / dt)):
            state, _ = lif_step(params, state, 10.0, jnp.zeros(1), dt=dt)
        return abs(float(state.v[0]) - 10.0 * (1 - np.exp(-1.0)))

    ratio = error(1e-3) / error(0.5e-3)
    assert 1.8 < ratio < 2.2


def test_constant_current_fires_at_the_textbook_rate():
    params = LIFParams(t_ref=5e-3)
    current, dt = 20.0, 1e-4

    def body(state, _):
        state, spikes = lif_step(params, state, current, jnp.zeros(1), dt=dt)
        return state, spikes[0]

    _, spikes = jax.lax.scan(body, lif_init(params, 1), None, length=20000)
    period = params.tau_m * np.log(current / (current - params.v_th)) + params.t_ref
    assert abs(int(spikes.sum()) - 2.0 / period) <= 1


def test_jump_counts_from_the_next_step_and_is_lost_while_refractory():
    params = LIFParams(t_ref=3e-3)
    jumps = np.zeros((8, 1), np.float32)
    jumps[0] = 20.0  # crosses: fires in step 1
    jumps[1] = jumps[2] = jumps[3] = 20.0  # spike step and two refractory steps: lost
    jumps[4] = 20.0  # spike + 3 ms: heard
    _, spikes, v = lif_scan(params, lif_init(params, 1), jnp.asarray(jumps), dt=DT)
    assert np.flatnonzero(spikes[:, 0]).tolist() == [1, 5]
    assert v[1:4, 0].tolist() == [0.0, 0.0, 0.0]
    assert float(v[4, 0]) == 20.0


@pytest.mark.parametrize(
    ("t_ref", "dt", "steps"),
    [(2e-3, 1e-3, 2), (2.9e-3, 1e-3, 2), (2.5e-3, 1e-3, 2), (0.9e-3, 1e-3, 0), (2.5e-3, 1e-4, 25),
     (0.7e-3, 2e-4, 3), (0.999, 1e-3, 999)],
)  # fmt: skip
def test_refractory_time_is_rounded_down_to_whole_steps_as_in_brian2(t_ref, dt, steps):
    """Brian 2: a neuron is free again when `timestep(t - lastspike) >= timestep(t_ref)`."""
    params = LIFParams(t_ref=t_ref)
    jumps = jnp.full((steps + 6, 1), 20.0)
    _, spikes, _ = lif_scan(params, lif_init(params, 1), jumps, dt=dt)
    # Free after `steps`, so the next jump lands in that step and fires it one step later.
    first, second = np.flatnonzero(spikes[:, 0])[:2]
    assert second - first == max(steps, 1) + 1


def test_gradient_below_threshold():
    params = LIFParams()

    def last(tau_m):
        _, _, v = lif_scan(
            params._replace(tau_m=tau_m), lif_init(params, 1), jnp.full((5, 1), 1.0), dt=DT
        )
        return v[-1, 0]

    tau, h = 20e-3, 1e-4
    numeric = (last(tau + h) - last(tau - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(last)(tau), numeric, rtol=1e-2)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"tau_m": -20e-3}, ["tau_m", "-0.02", "> 0"]),
        ({"tau_m": 0.4e-3}, ["dt=0.001", "2 tau_m", "smaller dt"]),
        ({"t_ref": -1e-3}, ["t_ref", ">= 0"]),
        ({"v_th": float("nan")}, ["v_th=nan", "expected finite"]),
        ({"v_reset": 20.0}, ["v_reset=20.0", "v_th = 15.0"]),
    ],
)
def test_bad_constants_are_named(change, names):
    with pytest.raises(ValueError) as error:
        check_lif(LIFParams(**change), dt=DT)
    for part in names:
        assert part in str(error.value)


def test_empty_layer_is_refused():
    with pytest.raises(ValueError, match="n=0"):
        lif_init(LIFParams(), 0)


def test_constants_may_be_traced():
    """A sweep may vmap over constants: the checks let traced values pass."""

    def run(tau_m):
        params = LIFParams(tau_m=tau_m)
        check_lif(params, dt=DT)
        return lif_step(params, lif_init(params, 1), 10.0, jnp.zeros(1), dt=DT)[0].v[0]

    np.testing.assert_allclose(jax.vmap(run)(jnp.array([10e-3, 20e-3])), [1.0, 0.5], rtol=1e-6)


def test_a_neuron_at_its_threshold_does_not_fire_and_one_above_does():
    """As in Brian 2, `v > v_th`."""
    params = LIFParams(v_rest=1.0, v_th=1.0, v_reset=0.0)
    state = lif_init(params, 2)
    state = state._replace(v=jnp.array([1.0, 1.5]))
    _, spikes = lif_step(params, state, 0.0, jnp.zeros(2), dt=1e-3)
    assert spikes.tolist() == [False, True]
