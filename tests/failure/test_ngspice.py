from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import spearmanr

from failure.circuits.ldo.circuit import make_ldo
from failure.circuits.ldo.reference import ldo_decks
from failure.circuits.solver import decks, ngspice
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Inductor,
    Load,
    Netlist,
    Resistor,
    Switch,
    VoltageSource,
)
from failure.circuits.solver.newton import dc
from failure.circuits.solver.system import compile_netlist
from failure.circuits.solver.values import nominal_values

needs_ngspice = pytest.mark.skipif(not ngspice.available(), reason="ngspice is not installed")


def test_missing_program_is_explained(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not ngspice.available()
    with pytest.raises(ngspice.NgspiceError, match="apt-get install ngspice"):
        make_ldo("level1").reference(np.zeros((1, 60)))


@needs_ngspice
def test_time_limit_and_broken_deck() -> None:
    (deck,) = ldo_decks(np.zeros((1, 60)), model="ekv", max_step=1e-13)
    with pytest.raises(ngspice.NgspiceError, match=r"more than 0\.2 s"):
        ngspice.run(deck, timeout=0.2)
    with pytest.raises(ngspice.NgspiceError, match="no result"):
        ngspice.run(decks.deck("broken", ["R1 a 0 nonsense q"], ["op", "print v(b)"]))
    numbers, status = ngspice.run_many([deck], ("iq",), timeout=0.2)
    assert np.isnan(numbers).all() and status.tolist() == [1]


@needs_ngspice
def test_every_linear_element_means_the_same() -> None:
    netlist = Netlist(
        "all",
        (
            VoltageSource("V1", "a", "0", 3.0),
            VoltageSource("V2", "b", "c", 0.5),
            CurrentSource("I1", "0", "d", 1e-3),
            Resistor("R1", "a", "b", 1e3),
            Inductor("L1", "c", "d", 1e-6),
            Capacitor("C1", "c", "0", 1e-12),
            Switch("S1", "d", "0", 1e3, 1e9, control=0.9),
            Load("B1", "d", "0", 2e-4, 0.5),
        ),
    )
    system = compile_netlist(netlist)
    with jax.enable_x64(True):
        values = nominal_values(system)
        v = np.asarray(dc(system, values).v)[:, 0]
        values = jax.tree.map(np.asarray, values)
    empty = jnp.zeros((0, 1))
    lines = decks.elements(netlist, values, 0, geometry=(np.asarray(empty), np.asarray(empty)))
    names = ("b", "c", "d")
    control = ["op", *(f"let n{n}=v({n})\nprint n{n}" for n in names)]
    found = ngspice.run(decks.deck("all", lines, control, options="reltol=1e-9 vntol=1e-12"))
    for name in names:
        assert found[f"n{name}"] == pytest.approx(v[system.index(name)], abs=1e-8)


def compare(n: int, model: str, scale: float) -> tuple[np.ndarray, np.ndarray]:
    x = scale * np.random.default_rng(0).normal(size=(n, 60))
    circuit = make_ldo(model)
    ours, ours_status = circuit.simulate(x)
    theirs, their_status = circuit.reference(x)
    assert not np.any(np.asarray(ours_status)) and not np.any(their_status)
    return np.asarray(ours), theirs


@needs_ngspice
@pytest.mark.parametrize(("model", "millivolts"), [("level1", 2.0), ("ekv", 0.6)])
def test_ldo_agrees(model: str, millivolts: float) -> None:
    ours, theirs = compare(8, model, 1.0)
    assert np.abs(ours / theirs - 1)[:, [0, 2]].max() < 1e-6
    assert np.abs(ours - theirs)[:, 1].max() < millivolts * 1e-3


@needs_ngspice
@pytest.mark.slow
def test_ldo_ranks_agree() -> None:
    ours, theirs = compare(200, "level1", 1.0)
    assert np.abs(ours / theirs - 1)[:, [0, 2]].max() < 1e-6
    assert np.abs(ours - theirs)[:, 1].max() < 2e-3
    for k in range(3):
        assert spearmanr(ours[:, k], theirs[:, k]).statistic >= 0.99
