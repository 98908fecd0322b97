"""The study of fixed probabilities: one cell, resumed without a further run; netlists; pictures."""

import json

import numpy as np
import pytest

from failure.circuits.solver import ngspice
from failure.problems import make_problem
from snn_fusion_failure.records import sigma_cases, sigma_netlists
from tests._scripts import load_script


def test_a_cell_is_measured_once_and_recorded(tmp_path):
    study = load_script("studies/study_sigma")
    config = study.Config(
        problems=("linear",), probabilities=(1e-6,), methods=("lines", "lines+gradient"), seeds=2,
        dim=12, out=tmp_path / "cells", record=tmp_path / "table.json", pictures=tmp_path,
    )  # fmt: skip
    rows = study.main(config)["rows"]
    by = {(r["model"], r["metric"]): r["mean"] for r in rows}
    assert {r["row"] for r in rows} == {"linear D=12 P=1e-06"}
    assert by["lines+gradient", "success_rate"] == by["lines", "coverage"] == 1.0
    assert by["lines+gradient", "sims_factor2"] <= 20 < by["lines", "sims_factor2"] <= 60
    assert by["lines+gradient", "design_point_cosine"] > 0.999
    cells = [json.loads(p.read_text()) for p in (tmp_path / "cells").rglob("lines/*.json")]
    met = sum(cell["first_failure"] is not None for cell in cells)
    assert len(cells) == 2 and by["lines", "first_failure_share"] == met / 2
    held = json.loads((tmp_path / "table.json").read_text())["rows"]
    shares = [r for r in held if r["metric"] in ("coverage", "known", "first_failure_share")]
    assert len(shares) == 6 and all(0 <= r["ci95"][0] < r["ci95"][1] <= 1 for r in shares)
    assert not any("truth_interval" in r for r in held)  # the truth is exact
    assert (tmp_path / "table_4_sigma.png").exists()
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "cells").rglob("*.json")}
    assert study.main(config)["rows"][0]["mean"] == rows[0]["mean"]
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps


def test_rows_say_how_many_runs_met_a_failure_and_how_well_the_truth_is_known(tmp_path):
    """One of four; subset simulation and regions do not count, so they have no share."""
    study = load_script("studies/study_sigma")
    case = study.Case("c", None, None, 1.0, 2, 1e-6, None, None, (0.9e-6, 1.2e-6))
    one = {"simulations": 9, "probability": 1e-6, "lower": 5e-7, "upper": 2e-6, "verdict": "good",
           "cosine": None, "gradients": 0}  # fmt: skip
    runs = [one | {"first_failure": first} for first in (None, 5.0, None, None)]
    rows = study.rows_of(case, "guided_lines", runs)
    by = {r["metric"]: r["mean"] for r in rows}
    assert by["first_failure_share"] == 0.25 and by["first_failure"] == 5.0
    assert all(r["truth_interval"] == [0.9e-6, 1.2e-6] for r in rows)
    silent = [one | {"first_failure": None}] * 2
    for method in ("regions+gradient", "subset_simulation"):
        rows = study.rows_of(case, method, silent)
        assert "first_failure_share" not in {r["metric"] for r in rows}
    config = study.Config(record=tmp_path / "table.json")
    assert study.other_rows(config, case)[0]["truth_interval"] == [0.9e-6, 1.2e-6]


@pytest.mark.parametrize("kind", ["circuit", "netlist"])
def test_a_measured_truth_comes_with_its_interval(kind, tmp_path):
    name, make, field = {
        "circuit": ("iq", sigma_cases.circuit_case, {"point": [1.0] * 60}),
        "netlist": ("memory_cell", sigma_netlists.netlist_case, {"points": [[1.0] * 6]}),
    }[kind]
    if kind == "netlist" and not ngspice.available():
        pytest.skip("ngspice is not installed")
    target = {"threshold": 2.0, "probability": 1e-6, "interval": [0.9e-6, 1.2e-6], **field}
    (tmp_path / f"threshold_{name}_1e-06.json").write_text(json.dumps(target))
    assert make(name, 1e-6, tmp_path).measured == {"truth_interval": [0.9e-6, 1.2e-6]}


def test_a_netlist_with_gradients_is_refused(tmp_path):
    study = load_script("studies/study_sigma")
    config = study.Config(problems=(), netlists=("memory_cell",), methods=("lines+gradient",))
    with pytest.raises(ValueError, match="a netlist has no gradients"):
        study.main(config)


def test_the_threshold_of_a_worst_of_two_holds_both_regions():
    """Two sides of a window, from their terms alone, against the closed form."""
    exact = make_problem("window", 1e-6, 12)
    axis = exact.points[0] / np.linalg.norm(exact.points[0])
    terms = [lambda x: np.asarray(x) @ axis, lambda x: -(np.asarray(x) @ axis)]
    found = sigma_netlists.measured_threshold(
        terms, lambda x: np.abs(np.asarray(x) @ axis), 12, 1e-6
    )
    assert found["threshold"] == pytest.approx(exact.threshold, abs=0.01)
    assert found["probability"] == pytest.approx(1e-6, rel=0.05)
    low, high = found["check_interval"]
    assert low < 1e-6 < high and found["verdict"] == "good"


@pytest.mark.skipif(not ngspice.available(), reason="ngspice is not installed")
def test_both_halves_of_the_memory_cell_are_the_same_circuit_mirrored():
    outputs = sigma_netlists.outputs_of(sigma_netlists.NETLISTS["memory_cell"])
    x = np.random.default_rng(0).normal(size=6)
    y = outputs(np.stack([x, np.roll(x, 3)]))
    assert np.all((y < -100.0) & (y > -250.0))
    np.testing.assert_allclose(y[0], y[1, ::-1], atol=0.5)


def test_searches_are_measured_without_any_method(tmp_path):
    study = load_script("studies/study_sigma")
    config = study.Config(
        problems=("linear",), probabilities=(1e-6,), methods=(), searches=("gradient_corner",),
        search_seeds=2, search_most=20, dim=12, out=tmp_path / "cells",
        record=tmp_path / "table.json",
    )  # fmt: skip
    rows = study.main(config)["rows"]
    by = {(r["model"], r["metric"]): r["mean"] for r in rows}
    assert by["gradient_corner", "success_rate"] == 1.0
    assert by["gradient_corner", "first_failure"] == 14.0  # nominal, a difference each, the corner
    fields = study.result({"rows": rows})
    assert fields == {"rows": len(rows)}


def test_a_picture_has_a_panel_for_each_problem_and_no_other():
    from failure.plots import plot_errors

    one = np.array([10.0, 20.0]), np.array([1.0, 1.1]), np.array([True, False])
    for count in (1, 2, 4, 7):
        figure = plot_errors({f"row {k}": {"lines": one} for k in range(count)})
        assert sum(axes.get_visible() for axes in figure.axes) == count
