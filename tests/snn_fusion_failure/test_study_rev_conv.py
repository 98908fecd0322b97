"""The study of reversible fusion: rows, columns, parts, and what it makes of single runs."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fusion.data import load
from fusion.presets import preset
from snn_fusion_failure.records import reversible_parts
from snn_fusion_failure.runs import write_json
from tests._scripts import load_script

study = load_script("studies/study_rev_conv")


def test_an_unknown_column_is_refused_with_those_that_are_there() -> None:
    with pytest.raises(ValueError, match=r"models=\['rev_argate'\]: expected some of \['baseline"):
        study.Config(models=("rev_argate",))


def test_single_runs_become_rows_and_paired_tests(tmp_path: Path) -> None:
    config = study.Config(
        rows=("n_clean=5 uniform",),
        models=("rev_conv_argate", "argate_l"),
        seeds=3,
        out=tmp_path / "runs",
        results=tmp_path / "results",
        collect_only=True,
    )
    for run in study.runs(config):
        better = 2.0 + 0.5 * run.seed if run.model == "rev_conv_argate" else 0.0
        record = {"accuracy": 90.0 + better, "failed_auroc": 0.7 + better / 100, "aux_loss": 1.0}
        write_json(run.path(config), record | {"unseen": {"accuracy": 70.0 + better}})
    restored = study.Run("restoration", "rev_conv_argate", 0)
    write_json(restored.path(config), {"body_acc_x": {"zeros": {"rmse": 1.0}}})
    memory = study.Run("memory", "rev_conv_argate", 0)
    cell = {"row": "depth 4", "model": "stored", "metric": "memory_by_depth", "unit": "MB"}
    write_json(memory.path(config), {"cells": [cell | {"value": 7.5}]})
    study.main(config)
    held = json.loads((tmp_path / "results" / "study_rev_conv.json").read_text())
    means = {(r["row"], r["model"], r["metric"]): r["mean"] for r in held["rows"]}
    assert means["n_clean=5 uniform", "rev_conv_argate", "accuracy"] == pytest.approx(92.5)
    assert means["unseen kinds", "argate_l", "accuracy"] == pytest.approx(70.0)
    assert means["body_acc_x restored", "zeros", "rmse"] == 1.0
    assert means["depth 4", "stored", "memory_by_depth"] == 7.5
    found = {pair["row"]: pair for pair in held["comparisons"]}
    # Differences 2, 2.5 and 3: t = 2.5 / (0.5 / sqrt 3); those of the AUROC are in points.
    assert found["n_clean=5 uniform"]["t"] == pytest.approx(2.5 / (0.5 / 3**0.5))
    assert found["n_clean=5 uniform, failed auroc"]["difference"] == pytest.approx(2.5)
    assert found["n_clean=5 uniform, aux loss"]["difference"] == 0.0
    assert found["unseen kinds"]["comparison"] == "rev_conv_argate - argate_l"


def test_the_nearest_window_is_by_the_other_sensors() -> None:
    train = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3, 4)), jnp.float32)
    moved = train[5:9].at[:, 1].set(9.0) + 0.01
    np.testing.assert_array_equal(reversible_parts.nearest(train, moved, 1), train[5:9, 1])


@pytest.mark.slow
def test_memory_grows_with_depth_only_where_activations_are_stored() -> None:
    data = load("simulated")
    made = preset(data, "rev_conv_baseline", "quick")
    cells = reversible_parts.memory_by_depth(made.model, made.hyper, data.train_x[:32], (2, 16))
    found = {(c["row"], c["model"], c["metric"]): c["value"] for c in cells}
    memory = {key[:2]: value for key, value in found.items() if key[2] == "memory_by_depth"}
    assert memory["depth 16", "recomputed"] < 1.15 * memory["depth 2", "recomputed"]
    assert memory["depth 16", "stored"] > 1.5 * memory["depth 2", "stored"]
    assert found["depth 16", "recomputed", "gradient_difference"] < 1e-3


# optax raises a float to a whole power, which strict promotion forbids.
@pytest.mark.relaxed
@pytest.mark.slow
def test_columns_train_and_tell_their_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "DATASET", "simulated")
    rows = {study.TRAINED_FOR_UNSEEN: {"protocol": "random", "n_clean": 3}}
    monkeypatch.setattr(study, "ROWS", rows)
    config = study.Config(rows=tuple(rows), preset="quick", changes=("train.epochs=3",))
    data = load("simulated")
    found = {
        model: study.execute(config, study.Run(study.TRAINED_FOR_UNSEEN, model, 0), data)
        for model in ("rev_conv_oracle", "rev_conv_argate_bayesian")
    }
    assert {"accuracy", "failed_auroc", "ece"} <= set(found["rev_conv_argate_bayesian"]["unseen"])
    assert found["rev_conv_oracle"]["failed_auroc"] == 1.0
    assert 0.0 < found["rev_conv_oracle"]["aux_loss"] < 3.0
    assert min(record["accuracy"] for record in found.values()) > 30.0  # four classes
    assert all(record["training_memory"] > 0.1 for record in found.values())


@pytest.mark.relaxed
@pytest.mark.slow
def test_a_sensor_is_restored_by_every_method(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "DATASET", "simulated")
    monkeypatch.setattr(study, "SENSORS", {"one": 1})
    rows = {study.TRAINED_FOR_UNSEEN: {"protocol": "random", "n_clean": 3}}
    monkeypatch.setattr(study, "ROWS", rows)
    monkeypatch.setattr(reversible_parts, "BNN_ROWS", 100)
    config = study.Config(
        rows=tuple(rows), sensors=("one",), preset="quick", changes=("train.epochs=2",)
    )
    run = study.Run("restoration", "rev_conv_argate", 0)
    found = study.execute(config, run, load("simulated"))["one"]
    assert found["its own features"]["largest_error"] < 1e-4
    assert found["zeros"]["rmse"] >= 0.99 > found["its own features"]["rmse"]
    assert 60.0 < found["Bayesian line on features"]["coverage_90"] <= 100.0
    assert "coverage_90" not in found["nearest neighbour"]
