from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import circuits
from failure.circuits.ldo.circuit import make_ldo
from failure.circuits.ldo.regulator import lowest, solve_ldo, time_grid, unresolved
from failure.circuits.ldo.schematic import I_HEAVY, NETLIST
from failure.circuits.outputs import performance_of, slopes_of
from failure.circuits.solver import ngspice
from failure.circuits.solver.netlist import Mosfet
from failure.status import Status

N = 8


@pytest.fixture(scope="module")
def samples() -> np.ndarray:
    """Nominal, six Gaussian samples, a corner of the box."""
    x = np.random.default_rng(7).normal(size=(N, 60))
    x[0] = 0.0
    x[-1] = 3.0 * np.sign(x[-1])
    return x


@pytest.fixture(scope="module")
def solved(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    specs, status = circuits.get("ldo").simulate(samples)
    return np.asarray(specs), np.asarray(status)


def test_interface() -> None:
    circuit = circuits.get("ldo")
    assert circuits.get("ldo") is circuit
    assert circuit.n_dims == 60 and len(NETLIST.of(Mosfet)) == 20
    assert circuit.parameter_names[:4] == (
        ("MB1", "length"),
        ("MB1", "vth"),
        ("MB1", "tox"),
        ("MB2", "length"),
    )
    lo, hi = circuit.bounds
    assert lo.shape == (60,) and np.all(lo == -3.0) and np.all(hi == 3.0)
    assert circuit.spec_names == ("quiescent_current", "undershoot", "load_regulation")
    assert circuit.spec_index("undershoot") == 1
    assert {s.sense for s in circuit.specs} == {"max"}


def test_result_is_float64_and_converged(solved) -> None:
    specs, status = solved
    assert specs.dtype == np.float64 and specs.shape == (N, 3)
    assert status.tolist() == [0] * N


def test_recorded_numbers(samples, solved, golden: Path) -> None:
    held = json.loads((golden / "circuits_ldo.json").read_text())
    np.testing.assert_allclose(solved[0], held["specs"], rtol=1e-6)


RINGING = np.random.default_rng(1).uniform(-3, 3, size=(60, 512))[:, 248]
"""A sample of the box that rings faster than the steps: its undershoot would be 19 mV too large."""


def test_a_ringing_that_the_steps_do_not_follow_is_not_converged(samples) -> None:
    x = np.concatenate([RINGING[None], samples[1:]])
    with jax.enable_x64(True):
        _, status = circuits.get("ldo")._jit(jnp.asarray(x))
    assert status.tolist() == [Status.NOT_CONVERGED] + [Status.GOOD] * (N - 1)


def test_what_the_steps_leave_open_is_half_a_step_squared_of_the_bend() -> None:
    t = np.array([0.0, 1.0, 3.0, 4.0])
    with jax.enable_x64(True):
        v = jnp.asarray(np.stack([(t - 1.5) ** 2, 0.0 * t], axis=1))
        np.testing.assert_allclose(unresolved(t, v), [4.0 * 2.0 / 8.0, 0.0])


@pytest.mark.slow
@pytest.mark.skipif(not ngspice.available(), reason="ngspice is not installed")
def test_a_ringing_sample_is_simulated_again_with_finer_steps() -> None:
    circuit = circuits.get("ldo")
    x = np.stack([np.zeros(60), RINGING])
    specs, status = map(np.asarray, circuit.simulate(x))
    trusted, their_status = circuit.reference(x)
    assert status.tolist() == their_status.tolist() == [0, 0]
    assert np.abs(specs - trusted)[:, 1].max() < 2e-3


@pytest.mark.slow
def test_a_sample_alone_is_the_sample_in_a_batch(samples, solved) -> None:
    """Padding and chunks included: ten rows are two chunks when a chunk is eight."""
    from failure.circuits.protocol import in_chunks

    with jax.enable_x64(True):
        x = jnp.asarray(np.concatenate([samples[::-1], samples[:2]]))
        specs, status = jax.jit(lambda x: in_chunks(solve_ldo, x, chunk=N))(x)
    np.testing.assert_allclose(specs[:N][::-1], solved[0], rtol=1e-9)
    np.testing.assert_allclose(specs[N:], solved[0][:2], rtol=1e-9)
    assert status.shape == (10,)


def test_lowest_finds_the_vertex_of_a_parabola() -> None:
    t = np.array([0.0, 0.3, 0.7, 1.0, 1.5])
    with jax.enable_x64(True):
        v = jnp.asarray(np.stack([(t - 0.6) ** 2 - 1.0, 2.0 - t], axis=1))
        found = lowest(t, v)
    np.testing.assert_allclose(found, [-1.0, 0.5], atol=1e-12)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match=r"circuit='lod': expected one of "):
        circuits.get("lod")
    circuit = circuits.get("ldo")
    with pytest.raises(ValueError, match=r"x of shape \(3, 44\): expected \[n, 60\]"):
        circuit.simulate(np.zeros((3, 44)))
    with pytest.raises(ValueError, match=r"spec='dropout': expected .* 'undershoot'"):
        circuit.spec_index("dropout")


@pytest.mark.slow
def test_finer_grid_moves_the_undershoot_little() -> None:
    """A sixth of the step moves it by less than a quarter of the 2 mV allowed against ngspice."""
    x = np.random.default_rng(3).normal(size=(60, 64))
    with jax.enable_x64(True):
        coarse, _ = jax.jit(solve_ldo)(jnp.asarray(x))
        exact, _ = jax.jit(lambda x: solve_ldo(x, time=time_grid(6)))(jnp.asarray(x))
    assert np.abs(np.asarray(coarse - exact))[1].max() < 0.5e-3


@pytest.mark.slow
def test_gradient_is_the_finite_difference() -> None:
    x = np.random.default_rng(5).normal(size=(1, 60))
    run = make_ldo().run
    with jax.enable_x64(True):
        at = jnp.asarray(x)
        reverse = np.asarray(jax.jit(jax.jacrev(lambda x: run(x)[0][0]))(at))[:, 0]
        evaluate = jax.jit(lambda x: run(x)[0][0])
        for k in (0, 22, 31, 58):
            h = 1e-3
            step = jnp.zeros_like(at).at[0, k].set(h)
            difference = np.asarray(evaluate(at + step) - evaluate(at - step)) / (2 * h)
            np.testing.assert_allclose(
                reverse[:, k], difference, rtol=1e-3, atol=1e-4 * np.abs(reverse).max(1).min()
            )


@pytest.mark.slow
def test_samples_of_the_box_converge() -> None:
    x = np.random.default_rng(11).uniform(-3, 3, size=(4096, 60))
    _, status = circuits.get("ldo").simulate(x)
    assert np.mean(np.asarray(status) != 0) < 1e-3
    assert I_HEAVY > 0


@pytest.mark.slow
def test_a_gradient_program_gives_the_same_values_and_the_slopes_of_differences() -> None:
    """One batch for both sides; three columns of transistors that matter, one that hardly does."""
    circuit = circuits.get("ldo")
    values, slopes = performance_of(circuit, "undershoot"), slopes_of(circuit, "undershoot")
    x = np.random.default_rng(5).normal(size=(2, 60))
    columns = (4, 31, 55)
    moved = [x + s * 1e-3 * np.eye(60)[k] for k in columns for s in (1.0, -1.0)]
    y = values(np.concatenate([x, *moved]))
    found, gradient = slopes(x)
    # Newton ends a step at 1e-8 V, and the two programs round differently on the way.
    np.testing.assert_allclose(found, y[:2], rtol=1e-6)
    differences = y[2:].reshape(len(columns), 2, 2)
    for k, (up, down) in zip(columns, differences, strict=True):
        scale = np.abs(gradient).max()
        np.testing.assert_allclose(gradient[:, k], (up - down) / 2e-3, atol=1e-4 * scale)
