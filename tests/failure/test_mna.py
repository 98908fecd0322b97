from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from failure.circuits.solver.elimination import eliminate, full_matrix
from failure.circuits.solver.mna import residual, source_current, stamps
from failure.circuits.solver.mosfet import NMOS, ekv
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Inductor,
    Load,
    Mosfet,
    Netlist,
    Resistor,
    Switch,
    VoltageSource,
)
from failure.circuits.solver.newton import dc
from failure.circuits.solver.system import compile_netlist
from failure.circuits.solver.transient import grid, transient
from failure.circuits.solver.values import nominal_values
from failure.status import Status


def solve(netlist: Netlist) -> dict[str, float]:
    system = compile_netlist(netlist)
    with jax.enable_x64(True):
        solution = dc(system, nominal_values(system))
    assert solution.status.tolist() == [0]
    return dict(zip(system.unknowns, np.asarray(solution.v)[:, 0].tolist(), strict=True))


DIVIDER = Netlist(
    "divider",
    (
        VoltageSource("V1", "a", "0", 3.0),
        Resistor("R1", "a", "b", 1e3),
        VoltageSource("V2", "b", "c", 0.5),
        Inductor("L1", "c", "d", 1e-6),
        Switch("S1", "d", "0", 1e3, 1e9, control=1.0),
        CurrentSource("I1", "0", "d", 1e-3),
    ),
)


def test_divider_with_floating_source_inductor_and_switch() -> None:
    v = solve(DIVIDER)
    current = (3.0 - 0.5 - 1.0) / 2e3  # 1 mA into 1 kOhm lifts d by 1 V
    assert v["b"] == pytest.approx(3.0 - 1e3 * current, abs=1e-8)
    assert v["c"] == pytest.approx(v["b"] - 0.5, abs=1e-12)
    assert v["d"] == pytest.approx(v["c"], abs=1e-12)
    assert v["V2#branch"] == pytest.approx(current, abs=1e-11)
    assert v["L1#branch"] == pytest.approx(current, abs=1e-11)


STAGE = Netlist(
    "stage",
    (
        VoltageSource("Vdd", "vdd", "0", 2.0),
        VoltageSource("Vin", "in", "0", 0.8),
        Resistor("RL", "vdd", "out", 2e3),
        Mosfet("M1", "out", "in", "0", "0", NMOS, 20e-6, 0.5e-6),
        Mosfet("M2", "vdd", "out", "low", "0", NMOS, 20e-6, 0.5e-6),
        Resistor("RS", "low", "0", 5e3),
        Load("B1", "low", "0", 1e-5, 0.3),
        Capacitor("C1", "out", "low", 1e-12),
    ),
)


def test_transistor_stage_against_scalar_root() -> None:
    v = solve(STAGE)
    system = compile_netlist(STAGE)
    with jax.enable_x64(True):
        values = nominal_values(system)
        m1, m2 = (jax.tree.map(lambda a, k=k: a[k, 0], values.mos) for k in (0, 1))

        def drain(out: float) -> float:
            return (2.0 - out) / 2e3 - float(ekv(m1, jnp.float64(0.8), jnp.float64(out))[0])

        out = brentq(drain, 0.0, 2.0, xtol=1e-13)

        def follow(low: float) -> float:
            i = float(ekv(m2, jnp.float64(out - low), jnp.float64(2.0 - low))[0])
            return i - low / 5e3 - 1e-5 * np.tanh(low / 0.3)

        low = brentq(follow, 0.0, 2.0, xtol=1e-13)
        solution = dc(system, values)
        supply = float(source_current(system, values, solution.v, name="Vdd")[0])
    assert v["out"] == pytest.approx(out, abs=1e-8)
    assert v["low"] == pytest.approx(low, abs=1e-8)
    drawn = (2.0 - out) / 2e3 + low / 5e3 + 1e-5 * np.tanh(low / 0.3)
    assert supply == pytest.approx(drawn, rel=1e-6)


def test_elimination_solves_the_assembled_matrix() -> None:
    system = compile_netlist(STAGE)
    with jax.enable_x64(True):
        values = nominal_values(system)
        v = jnp.array([[1.0, 1.3], [0.4, 0.2]])
        f, entries = residual(
            system, stamps(system, values._replace(volts=values.volts * jnp.array([[1.0, 1.1]]))), v
        )
        x = eliminate(system, entries, f)
        dense = np.zeros((2, system.n, system.n))
        for (i, j), g in entries.items():
            dense[:, i, j] = g
        jacobian = jax.jacfwd(lambda u: residual(system, stamps(system, values), u[:, None])[0])
        np.testing.assert_allclose(dense[0], jacobian(v[:, 0])[:, 0, :], rtol=1e-12)
    for k in range(2):
        np.testing.assert_allclose(x[:, k], np.linalg.solve(dense[k], f[:, k]), rtol=1e-10)


@pytest.mark.parametrize("netlist", [STAGE, DIVIDER], ids=["stage", "divider"])
def test_incidence_matrices_are_the_same_equations(netlist) -> None:
    """Residual and Jacobian, entry by entry and by matrices; the solution of both."""
    sparse, dense = (compile_netlist(netlist, dense=d) for d in (False, True))
    with jax.enable_x64(True):
        values = nominal_values(sparse)
        v = jnp.asarray(np.random.default_rng(0).normal(size=(sparse.n, 2)))
        values = values._replace(volts=values.volts * jnp.array([[1.0, 1.1]]))
        f, entries = residual(sparse, stamps(sparse, values), v)
        g, matrix = residual(dense, stamps(dense, values), v)
        np.testing.assert_allclose(g, f, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(matrix, full_matrix(sparse, entries, 2), rtol=1e-12, atol=1e-18)
        np.testing.assert_allclose(
            eliminate(dense, matrix, g), eliminate(sparse, entries, f), rtol=1e-9, atol=1e-12
        )


@pytest.fixture(scope="module")
def stage_out():
    """Output voltage of the stage as a function of threshold shifts `[2, b]`, and its status."""
    system = compile_netlist(STAGE)

    @jax.jit
    def out(shift: jax.Array) -> tuple[jax.Array, jax.Array]:
        values = nominal_values(system)
        values = values._replace(mos=values.mos._replace(vto=values.mos.vto + shift))
        solution = dc(system, values)
        return solution.v[system.index("low")], solution.status

    return out


def test_implicit_gradient_is_the_finite_difference(stage_out) -> None:
    with jax.enable_x64(True):
        at = jnp.array([[0.01], [-0.02]])
        reverse = jax.grad(lambda s: stage_out(s)[0][0])(at)
        _, forward = jax.jvp(lambda s: stage_out(s)[0], (at,), (jnp.array([[1.0], [0.0]]),))
        h = 1e-5
        for k in range(2):
            up, down = (stage_out(at.at[k, 0].add(s * h))[0][0] for s in (1, -1))
            assert float(reverse[k, 0]) == pytest.approx(float(up - down) / (2 * h), rel=1e-6)
    assert float(forward[0]) == pytest.approx(float(reverse[0, 0]), rel=1e-12)


def test_result_does_not_depend_on_the_neighbours(stage_out) -> None:
    with jax.enable_x64(True):
        shift = jnp.array([[0.0, 0.3, -0.4, 0.8], [0.0, -0.2, 0.5, 0.1]])
        together, _ = stage_out(shift)
        alone = jnp.concatenate([stage_out(shift[:, k : k + 1])[0] for k in range(4)])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


def test_a_sample_that_does_not_converge_is_flagged() -> None:
    system = compile_netlist(STAGE)
    with jax.enable_x64(True):
        values = nominal_values(system)
        bad = values._replace(ohms=values.ohms * jnp.array([[1.0, jnp.nan]]))
        status = dc(system, bad).status
    assert status.tolist() == [Status.GOOD, Status.NOT_CONVERGED]


def lc_error(steps: int, dense: bool) -> float:
    """Largest error of an undamped LC ring that starts when a current is cut."""
    netlist = Netlist(
        "LC",
        (
            CurrentSource("I1", "0", "a", 1e-3),
            Inductor("L1", "a", "0", 1e-6),
            Capacitor("C1", "a", "0", 1e-9),
            Resistor("R1", "a", "0", 1e9),
        ),
    )
    system = compile_netlist(netlist, dense=dense)
    time = grid((0.0, 3e-7, steps, 1.0), euler_steps=1)  # the source jumps
    wave = np.zeros((steps + 1, 1))
    wave[0] = 1e-3
    with jax.enable_x64(True):
        values = nominal_values(system)
        start = dc(system, values)
        (a, i), end = transient(
            system, time, values, start, {"I1": jnp.asarray(wave)}, probes=("a", "L1#branch")
        )
    assert end.status.tolist() == [0]
    omega = 1 / np.sqrt(1e-15)
    i_exact = 1e-3 * np.cos(omega * time.t)
    a_exact = -1e-3 * np.sqrt(1e-6 / 1e-9) * np.sin(omega * time.t)
    return max(
        np.abs(np.asarray(i)[:, 0] - i_exact).max() / 1e-3,
        np.abs(np.asarray(a)[:, 0] - a_exact).max() / 3.2e-2,
    )


@pytest.mark.parametrize("dense", [False, True])
def test_trapezoidal_rule_is_of_second_order(dense: bool) -> None:
    coarse, fine = lc_error(100, dense), lc_error(200, dense)
    assert fine < 1e-2
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_bad_netlists_and_names_are_explained() -> None:
    source = VoltageSource("V1", "a", "0", 1.0)
    with pytest.raises(ValueError, match="used twice: V1"):
        Netlist("n", (source, source))
    with pytest.raises(ValueError, match=r"R1\.ohms=-1"):
        Netlist("n", (source, Resistor("R1", "a", "0", -1.0)))
    with pytest.raises(ValueError, match="touches ground"):
        Netlist("n", (Resistor("R1", "a", "b", 1.0),))
    with pytest.raises(ValueError, match="two voltage sources fix node 'a'"):
        compile_netlist(Netlist("n", (source, VoltageSource("V2", "a", "0", 1.0))))
    with pytest.raises(ValueError, match=r"holds b.*add a resistance"):
        compile_netlist(Netlist("n", (source, Capacitor("C1", "a", "b", 1e-12))))
    system = compile_netlist(STAGE)
    with pytest.raises(ValueError, match="node='nowhere': expected"):
        system.index("nowhere")
    with pytest.raises(ValueError, match="expected a piece with steps that starts at 1"):
        grid((0.0, 1.0, 2, 1.0), (2.0, 3.0, 2, 1.0))
