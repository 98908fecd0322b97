"""The studies beside Tables 3.1 to 3.6: their cells, resuming, and what becomes of single runs."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.data import from_arrays, load
from fusion.failures import corrupt, no_failure, random_failing
from fusion.loop import Corruption
from snn_fusion_failure.records import ceilings, dedicated, fusion_tables, sensor_cases
from snn_fusion_failure.runs import write_json
from tests._scripts import load_script

study = load_script("studies/study_sensors")


@pytest.mark.parametrize("name", ["driver_heads", "driver_trip", "driver_tagged"])
def test_the_driver_studies_hold_both_noises_and_all_columns(name: str) -> None:
    config = study.Config(study=name, seeds=2)
    cells = [(run.case.name, run.model) for run in study.runs(config)]
    wanted = {f"n_clean={n} {kind}" for n in (12, 8, 5) for kind in ("uniform", "gaussian")}
    assert {row for row, _ in cells} == wanted
    assert {"oracle", "linear_fit", "argate_l_printed"} < {model for _, model in cells}
    half = len(cells) // 2
    assert cells[:half] == cells[half:]  # whole seeds first
    assert len(set(cells)) == half == 60


def test_an_unknown_column_is_refused_with_those_that_are_there() -> None:
    with pytest.raises(ValueError, match=r"models=\['argate'\]: expected some of \['equal_weigh"):
        study.Config(models=("argate",))


def test_single_runs_become_differences_with_holms_p_values(tmp_path: Path) -> None:
    config = study.Config(
        study="driver_heads",
        rows=("n_clean=8 uniform",),
        models=("equal_weights", "argate_plus", "argate_l"),
        seeds=3,
        out=tmp_path / "runs",
        results=tmp_path / "results",
        collect_only=True,
    )
    gain = {"equal_weights": (0, 0, 0), "argate_plus": (2, 2.5, 3), "argate_l": (3, 1, 2)}
    for run in study.runs(config):
        accuracy = 70.0 + run.seed + gain[run.model][run.seed]
        record = {"accuracy": accuracy, "gate_auroc_pooled": float("nan"), "git": f"c{run.seed}"}
        write_json(run.path(config), record)
    study.main(config)
    held = json.loads((tmp_path / "results" / "study_driver_heads.json").read_text())
    rows = {(r["model"], r["metric"]): r for r in held["rows"]}
    assert {metric for _, metric in rows} == {"accuracy", "above_equal_weights"}
    apart = rows["argate_plus", "above_equal_weights"]
    assert apart["values"] == pytest.approx([2.0, 2.5, 3.0]) and apart["git"] == "c0, c1, c2"
    # t = 2.5 / (0.5 / sqrt 3) on two degrees of freedom: p = 1 - t / sqrt(t^2 + 2).
    t = 2.5 / (0.5 / 3**0.5)
    (tested,) = [c for c in held["comparisons"] if c["comparison"] == "argate_plus - equal_weights"]
    assert tested["p_value"] == pytest.approx(1.0 - t / (t * t + 2.0) ** 0.5)
    # The smallest of three comparisons: both above equal weights, and one above the other.
    assert len(held["comparisons"]) == 3
    assert tested["p_holm"] == pytest.approx(3 * tested["p_value"])
    # A machine that has the table only goes on from it, to the same numbers.
    shutil.rmtree(tmp_path / "runs")
    study.main(dataclasses.replace(config, restore=True))
    again = json.loads((tmp_path / "results" / "study_driver_heads.json").read_text())
    assert (again["rows"], again["comparisons"]) == (held["rows"], held["comparisons"])


def test_runs_go_on_after_an_interruption_and_the_table_is_there_after_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = sensor_cases.Case("small", {"dataset": "simulated"}, ("equal_weights", "argate_l"))
    monkeypatch.setitem(study.STUDIES, "driver_heads", ("Small, accuracy %", [case]))
    config = study.Config(
        study="driver_heads", seeds=2, validation=True, out=tmp_path / "o", results=tmp_path
    )
    table, done = tmp_path / "study_driver_heads_validation.json", []

    def execute(run: Any, dataset: Any, preset: str) -> dict[str, Any]:
        assert table.exists() == bool(done)
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append((run.model, run.seed))
        assert len(dataset.test_y) < len(load("simulated").train_y)
        return {"accuracy": 50.0, "git": "c"}

    monkeypatch.setattr(study, "execute", execute)
    with pytest.raises(KeyboardInterrupt):
        study.main(config)
    assert done == [("equal_weights", 0), ("argate_l", 0)]
    done_before = list(done)
    monkeypatch.setattr(
        study,
        "execute",
        lambda run, *_: done.append((run.model, run.seed)) or {"accuracy": 1.0, "git": "c"},
    )
    study.main(config)
    assert done == [*done_before, ("equal_weights", 1), ("argate_l", 1)]
    assert "validation rows" in json.loads(table.read_text())["title"]


def test_the_validation_rows_are_training_rows_that_the_seed_draws(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Each row carries its number; one class after the other, as in the driver's file.
    x = np.linspace(-1.0, 1.0, 400, dtype=np.float32)[:, None, None]
    data = from_arrays(np.repeat(x, 2, 1), np.repeat(np.arange(4), 100))
    monkeypatch.setattr("fusion.data.load", lambda *_, **__: data)
    parts = [
        study.load_data(study.Config(study="driver_heads", validation=True, split_seed=s))
        for s in (0, 1)
    ]
    held, other = ({float(v) for v in part.test_x[:, 0, 0]} for part in parts)
    assert held != other and len(held) == 60
    ends = {-1.0, 1.0}  # rows outside the training range are clipped to these
    assert not held & {float(v) for v in data.test_x[:, 0, 0]} - ends
    assert not held & {float(v) for v in parts[0].train_x[:, 0, 0]}
    for part in parts:  # 15 of each class are expected, with a standard deviation below 3.4
        assert np.bincount(part.test_y, minlength=4).min() >= 5


def test_a_dedicated_network_answers_where_its_sensor_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    data = from_arrays(rng.normal(size=(600, 3, 4)).astype(np.float32), np.arange(600) % 4)

    def predicted(part: Any, *_: Any) -> np.ndarray:
        if part.n_channels == 3:
            return data.test_y
        # The networks of the sensors are right, right in every class but 0, and never.
        (sensor,) = (data.channels.index(name) for name in part.channels)
        np.testing.assert_array_equal(part.test_x[:, 0], data.test_x[:, sensor])
        np.testing.assert_array_equal(part.scale.low, data.scale.low[sensor : sensor + 1])
        return (data.test_y, np.maximum(data.test_y, 1), (data.test_y + 1) % 4)[sensor]

    monkeypatch.setattr(dedicated, "_predicted", predicted)
    alone = random_failing(data.channels, n_clean=1)
    noise = Corruption(alone, alone, "uniform")
    found = dedicated.dedicated(data, noise, 0, preset="quick")
    key = jax.random.fold_in(jax.random.key(0), 3)
    failed = np.asarray(corrupt(alone, jnp.asarray(data.test_x), "uniform", key=key)[1])
    works = ~failed[failed.any(1)]
    y = data.test_y[failed.any(1)]
    right = works[:, 0] | (works[:, 1] & (y > 0))
    assert 0.4 < right.mean() < 0.8
    assert found["accuracy_clean"] == 100.0
    assert found["accuracy_corrupted"] == pytest.approx(100.0 * right.mean())
    both = random_failing(data.channels, n_clean=2)
    with pytest.raises(
        ValueError, match=r"noise\.test\.low=1, noise\.test\.high=1: expected 2 of 3"
    ):
        dedicated.dedicated(data, Corruption(both, both, "uniform"), 0, preset="quick")


def test_neighbours_are_looked_up_for_drawn_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sklearn", reason="ceilings need the extra sklearn")
    rng = np.random.default_rng(0)
    y = np.arange(800) % 2
    x = (y + 0.1 * rng.normal(size=800))[:, None, None].astype(np.float32)
    data = from_arrays(x, y)
    # The first half of the test rows is right, the second half has the other label.
    half = len(data.test_y) // 2
    wrong = np.r_[data.test_y[:half], 1 - data.test_y[half:]].astype(np.int32)
    data = dataclasses.replace(data, test_y=wrong)
    monkeypatch.setattr(ceilings, "KNN_ROWS", half)
    protocol = no_failure(data.channels)
    found = ceilings.score("nearest_rows", data, Corruption(protocol, protocol), 0)
    assert 35.0 < found["accuracy"] < 65.0


@pytest.mark.parametrize("name", fusion_tables.TRIVIAL)
def test_trivial_learners_read_whole_windows(name: str) -> None:
    """Classes that only the last sample tells; a clean row has no corrupted part."""
    pytest.importorskip("sklearn", reason="ceilings need the extra sklearn")
    rng = np.random.default_rng(0)
    y = np.arange(400) % 2
    x = 0.1 * rng.normal(size=(400, 1, 4)).astype(np.float32)
    x[:, 0, -1] += y
    data = from_arrays(x, y)
    protocol = no_failure(data.channels)
    found = ceilings.score(name, data, Corruption(protocol, protocol), 0)
    assert found["accuracy"] == found["accuracy_clean"] > 95.0
    assert "accuracy_corrupted" not in found
