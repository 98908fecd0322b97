"""The study of spiking fusion: its rows and columns, and what it makes of single runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fusion.data import load
from snn_fusion_failure.runs import write_json
from tests._scripts import load_script

study = load_script("studies/study_spiking_fusion")


def test_an_unknown_row_is_refused_with_those_that_are_there() -> None:
    with pytest.raises(ValueError, match=r"rows=\['n_clean=2'\]: expected some of \['n_clean=5"):
        study.Config(rows=("n_clean=2",))


def test_single_runs_become_rows_and_paired_tests(tmp_path: Path) -> None:
    config = study.Config(
        rows=("n_clean=5 uniform",),
        models=("spiking_argate", "spiking_baseline"),
        seeds=3,
        out=tmp_path / "runs",
        results=tmp_path / "results",
        collect_only=True,
    )
    for run in study.runs(config):
        better = 2.0 + 0.5 * run.seed if run.model == "spiking_argate" else 0.0
        kinds = {"zero": 80.0 + better, "drift": 70.0 + better}
        record = {"accuracy": 90.0 + better, "gate_auroc_pooled": float("nan"), "unseen": kinds}
        write_json(run.path(config), record)
    study.main(config)
    held = json.loads((tmp_path / "results" / "study_spiking_fusion.json").read_text())
    means = {(r["row"], r["model"]): r["mean"] for r in held["rows"] if r["metric"] == "accuracy"}
    assert means["n_clean=5 uniform", "spiking_argate"] == pytest.approx(92.5)
    assert means["unseen kinds", "spiking_baseline"] == pytest.approx(75.0)
    assert {r["metric"] for r in held["rows"]} == {"accuracy"}
    (seen, unseen) = held["comparisons"]
    assert seen["comparison"] == "spiking_argate - spiking_baseline"
    # Differences 2, 2.5 and 3: t = 2.5 / (0.5 / sqrt 3).
    assert seen["t"] == pytest.approx(2.5 / (0.5 / 3**0.5))
    assert unseen["row"] == "unseen kinds" and seen["p_holm"] == pytest.approx(2 * seen["p_value"])


def test_rows_of_failing_sensors_are_averaged_seed_by_seed() -> None:
    def cell(row: str, values: list[float], **more: Any) -> dict[str, Any]:
        base = {"row": row, "model": "m", "metric": "accuracy", "n": len(values), "values": values}
        return base | more

    eight, five = (cell(row, [96.0, 93.0]) for row in study.FAILING[:2])
    assert study.failing_means([eight, five]) == []
    one = cell(study.FAILING[2], [60.0, 66.0], seeds=[1, 0])
    (mean,) = study.failing_means([eight, five, one, cell("clean", [0.0, 0.0])])
    assert mean["seeds"] == [0, 1] and mean["values"] == pytest.approx([86.0, 82.0])


# optax raises a float to a whole power, which strict promotion forbids.
@pytest.mark.relaxed
@pytest.mark.slow
def test_a_column_trains_and_tells_its_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = {"small": {"dataset": "simulated", "protocol": "random", "n_clean": 3}}
    monkeypatch.setattr(study, "ROWS", rows)
    config = study.Config(rows=("small",), preset="quick", changes=("train.epochs=3",))
    data = load("simulated")
    found = {
        model: study.execute(config, study.Run("small", model, 0), data)
        for model in ("argate_l", "spiking_argate", "spiking_fixed_linear", "spiking_reward_stdp")
    }
    assert found["argate_l"]["synaptic_operations"] == 0.0
    assert found["argate_l"]["multiply_adds_with_fft"] < found["argate_l"]["multiply_adds"]
    assert found["spiking_argate"]["synaptic_operations"] > 0.0
    assert min(record["accuracy"] for record in found.values()) > 30.0  # four classes
