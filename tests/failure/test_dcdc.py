from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm as scipy_expm
from scipy.stats import spearmanr

from failure import circuits
from failure.circuits.buck import converter, schematic
from failure.circuits.buck.circuit import make_dcdc
from failure.circuits.buck.cycle import Stage, expm, pwm_cycle, stage_matrix
from failure.circuits.solver import ngspice


@pytest.fixture(scope="module")
def stage() -> Stage:
    with jax.enable_x64(True):
        numbers = (1e-6, 10e-6, 0.03, 0.03, 5e3, 20e3, 1e-12, 1.5e-3, 2.4e-5, 1e-5, 1.2, 1.24)
        return Stage(*(jnp.full((1,), v) for v in numbers))


def test_matrix_exponential_of_a_period(stage: Stage) -> None:
    with jax.enable_x64(True):
        a, _, _ = stage_matrix(stage, jnp.ones(1), jnp.full((1,), 0.1), jnp.full((1,), 0.2))
        found = np.asarray(expm(a * 250e-9))[:, :, 0]
        wanted = scipy_expm(np.asarray(a)[:, :, 0] * 250e-9)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


def test_cycle_is_the_integrated_circuit(stage: Stage) -> None:
    """Trip time, end state and peak of a period against an adaptive integrator with an event."""
    slope, t_ramp, delay, period = 0.8 / 235e-9, 3e-9, 1e-9, 250e-9
    x0 = np.array([0.28, 1.19, 0.02, 0.0, 1.0])
    with jax.enable_x64(True):
        one = jnp.ones(1)
        low = stage_matrix(stage, 0.0 * one, 0.09 * one, 0.2 * one)
        high = stage_matrix(stage, 2.5 * one, 0.15 * one, 0.2 * one)
        x, t, peak = jax.jit(
            lambda x: pwm_cycle(
                low, high, x, 0.5 * period * one, ramp_start=0.8 * one, ramp_slope=slope,
                t_ramp=t_ramp * one, delay=delay * one, period=period, iterations=5,
            )
        )(jnp.asarray(x0)[:, None])  # fmt: skip
    (a_low, out, comp), (a_high, _, _) = (
        tuple(np.asarray(m)[..., 0] for m in half) for half in (low, high)
    )

    def trip(time: float, state: np.ndarray) -> float:
        return float(comp @ state - (0.8 + slope * (time - t_ramp)))

    trip.terminal = False
    tight = {"rtol": 1e-11, "atol": 1e-14, "method": "DOP853", "dense_output": True}
    first = solve_ivp(lambda _, s: a_low @ s, (0, 200e-9), x0, events=trip, **tight)
    meet = first.t_events[0][0]
    rise = meet + delay
    second = solve_ivp(lambda _, s: a_high @ s, (rise, period), first.sol(rise), **tight)
    curve = [out @ first.sol(np.linspace(0, rise, 4001)), out @ second.sol(
        np.linspace(rise, period, 4001))]  # fmt: skip
    assert float(t[0]) == pytest.approx(meet, abs=1e-14)
    np.testing.assert_allclose(x[:, 0], second.y[:, -1], rtol=1e-7)
    assert float(peak[0]) == pytest.approx(max(c.max() for c in curve), abs=2e-7)


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    x = np.random.default_rng(2).normal(size=(4, 44))
    x[0] = 0.0
    return x


def test_interface_and_nominal(samples: np.ndarray) -> None:
    circuit = circuits.get("dcdc")
    assert circuit.n_dims == 44 and len(schematic.MOSFETS) == 22
    assert circuit.spec_names == ("output_accuracy", "overshoot")
    assert circuit.parameter_names[1] == ("MA1", "width")
    specs, status = map(np.asarray, circuit.simulate(samples))
    assert status.tolist() == [0] * 4
    assert np.all(specs[:, 0] < 15e-3)
    # The peak is above the mean by half the ripple, 2.3 mV in the series resistance, at least.
    assert np.all(np.abs(specs[:, 1] - 8e-3) < 0.5e-3 + specs[:, 0])
    np.testing.assert_allclose(specs[0], circuit.nominal, rtol=1e-9)


@pytest.mark.slow
def test_metrics_are_smooth() -> None:
    """A ten times finer grid moves every specification by less than 1 % of its spread."""
    x = np.random.default_rng(3).normal(size=(44, 32))
    with jax.enable_x64(True):
        coarse, _ = jax.jit(converter.solve_dcdc)(jnp.asarray(x))
        fine, _ = jax.jit(partial(converter.solve_dcdc, refine=10, points=40))(jnp.asarray(x))
    move = np.abs(np.asarray(coarse - fine)).max(axis=1)
    assert np.all(move < 0.01 * np.asarray(fine).std(axis=1))


@pytest.mark.slow
@pytest.mark.skipif(not ngspice.available(), reason="ngspice is not installed")
def test_ranks_agree_with_every_transistor_switching() -> None:
    circuit = make_dcdc("level1")
    x = np.random.default_rng(0).normal(size=(24, 44))
    ours, status = map(np.asarray, circuit.simulate(x))
    theirs, their_status = circuit.reference(x, max_step=2e-9)
    assert not status.any() and not their_status.any()
    for k in range(2):
        assert spearmanr(ours[:, k], theirs[:, k]).statistic >= 0.9
