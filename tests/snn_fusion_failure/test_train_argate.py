"""The fusion scripts on simulated windows: they run, resume, refuse, and their tables add up."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest

from fusion.data import load
from fusion.data.csv_folder import read_windows
from fusion.fitted_sensors import FittedSensors
from snn_fusion_failure.commands import train_argate
from snn_fusion_failure.commands.argate_networks import kept_sentence, network_files
from snn_fusion_failure.commands.argate_report import printed
from snn_fusion_failure.commands.argate_runs import Config, build_cases, build_settings
from snn_fusion_failure.records import fusion_tables
from snn_fusion_failure.records.fusion_tables import Row, Run
from snn_fusion_failure.runs import append_metrics, repository, write_json
from tests._scripts import load_script

reproduce = load_script("studies/reproduce")
study_argate = load_script("studies/study_argate")

# optax's Adam raises a float to an integer power, which strict promotion forbids.
pytestmark = pytest.mark.relaxed

SMALL = Config(dataset="simulated", preset="quick", protocol="random", n_clean=1, epochs=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Config, dict[str, Any]]:
    import jax

    config = dataclasses.replace(SMALL, out=tmp_path_factory.mktemp("runs") / "argate")
    with jax.numpy_dtype_promotion("standard"):
        return config, train_argate.main(config)


@pytest.mark.slow
def test_a_run_leaves_numbers_and_pictures(
    run: tuple[Config, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    config, summary = run
    assert config.out is not None
    names = {"config.json", "metrics.jsonl", "result.json", "confusion.png", "training.png"}
    assert names | {"gate.png", "checkpoints"} <= {p.name for p in config.out.iterdir()}
    result = json.loads((config.out / "result.json").read_text())
    assert result["accuracy"] == summary["accuracy"]
    assert 25.0 < result["accuracy"] <= 100.0  # four classes, even after two epochs
    assert sum(map(sum, result["confusion"])) == 1024
    third = (result["accuracy_clean"] + 2 * result["accuracy_corrupted"]) / 3
    assert result["accuracy"] == pytest.approx(third, abs=0.2)
    assert result["rows"] == "test"
    assert {"command", "git", "versions"} <= set(result["provenance"])
    lines = (config.out / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in lines] == [1, 2]


@pytest.mark.slow
def test_a_run_folder_is_not_written_twice(run: tuple[Config, dict[str, Any]]) -> None:
    config, summary = run
    with pytest.raises(ValueError, match=r"already holds a run; pass --resume"):
        train_argate.main(config)
    changed = dataclasses.replace(config, resume=True, seed=5)
    with pytest.raises(ValueError, match=r"other settings \(seed: 0 -> 5\)"):
        train_argate.main(changed)
    # Resuming a finished run trains no further: the same network, scored again.
    again = train_argate.main(dataclasses.replace(config, resume=True))
    assert again["accuracy"] == summary["accuracy"]
    assert config.out is not None
    assert len((config.out / "metrics.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dataset": "kitty"}, r"name='kitty': expected one of .*'simulated'"),
        ({"model": "argate"}, r"model='argate': expected one of 'baseline', 'netgated'"),
        ({"kind": "fog"}, r"kind='fog': expected one of 'uniform', 'gaussian'"),
        ({"preset": "best"}, r"preset='best': expected one of 'quick', 'paper'"),
        ({"n_clean": 7}, r"n_clean.*7"),
        (
            {"protocol": "generalisation", "n_clean": None, "test_range": (3, 8)},
            r"test\[1\]=8: expected a whole number 3..6",
        ),
        ({"test_range": (3, 5)}, r"test_range=\(3, 5\): expected --protocol generalisation"),
        ({"protocol": "clean"}, r"n_clean=1: expected --protocol random or fixed"),
        ({"epochs": 0}, r"epochs=0: expected a whole number"),
        ({"beta": -1.0}, r"beta=-1.0: expected a number >= 0"),
        ({"changes": ("model.loss.uniform_flor=0",)}, r"did you mean uniform_floor\?"),
    ],
)
def test_bad_settings_are_refused_before_a_folder_is_made(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path / "run", **change)
    with pytest.raises(ValueError, match=message):
        train_argate.main(config)
    assert not (tmp_path / "run").exists()


def test_options_reach_the_settings() -> None:
    data = load("simulated")
    config = Config(
        dataset="simulated",
        normalizer="softmax_sigmoid",
        epochs=3,
        learning_rate=0.1,
        alpha=0.2,
        beta=0.3,
        tau=0.4,
        protocol="generalisation",
        train_range=(1, 2),
        test_range=(3, 5),
        kind="gaussian",
        redraw=False,
        changes=("model.loss.uniform_floor=0.5", "train.batch_size=16"),
    )
    settings = build_settings(config, data)
    (case,) = build_cases(config, data).values()
    corruption = case.noise
    assert settings.model.normalizer == "softmax_sigmoid"
    assert settings.model.loss.fixed_targets == "softmax_sigmoid"
    assert (settings.model.loss.uniform_floor, settings.train.batch_size) == (0.5, 16)
    assert (settings.train.epochs, settings.hyper.learning_rate) == (3, 0.1)
    assert settings.hyper.loss[:3] == (0.2, 0.3, 0.4)
    assert (corruption.kind, corruption.redraw) == ("gaussian", False)
    assert corruption.train != corruption.test


@pytest.mark.slow
def test_without_options_clean_and_failing_cases_stand_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Config(dataset="simulated", epochs=1, out=tmp_path / "run")
    assert (config.preset, config.protocol) == ("paper", None)
    summary = train_argate.main(config)
    text = capsys.readouterr().out.splitlines()
    assert text[0].split() == ["accuracy", "%", "ceiling", "%"]
    assert [re.split(r"\s{2,}", line.strip())[0] for line in text[1:5]] == [
        "all sensors work",
        "3 of 6 sensors fail",
        "examples without a failed sensor",
        "examples with failed sensors",
    ]
    assert text[5].startswith("2 networks (argate_l, preset paper, 1 epochs, seed 0) learned from")
    assert re.fullmatch(
        r"result: dataset=simulated model=argate_l clean=[\d.]+ random=[\d.]+", text[-1]
    )
    assert summary["cases"]["clean"]["ceiling"] > summary["cases"]["random"]["ceiling"]
    assert {"cases.png", "confusion_clean.png", "gate_random.png"} <= {
        path.name for path in config.out.iterdir()
    }


def test_the_printed_accuracy_stands_beside_the_same_case_only() -> None:
    config = Config(dataset="har", model="argate_plus")
    data = dataclasses.replace(
        load("simulated"), name="har", channels=tuple("abcdefghi"), split="subject"
    )

    def sources(**changes: Any) -> list[float | None]:
        other = dataclasses.replace(config, **changes)
        return [printed(other, case.noise) for case in build_cases(other, data).values()]

    assert sources() == [95.69, 87.68]
    assert sources(kind="gaussian", n_clean=1) == [95.69, 73.19]
    assert sources(n_clean=2) == [95.69, None]
    assert sources(protocol="generalisation") == [77.1]
    assert sources(model="oracle") == [None, None]


def test_a_resumed_run_has_each_epoch_once(tmp_path: Path) -> None:
    for epoch in (1, 2, 3):
        append_metrics(tmp_path, {"case": "random", "epoch": epoch})
    append_metrics(tmp_path, {"case": "clean", "epoch": 3})
    train_argate.forget_from(tmp_path, "random", 2)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in lines] == [1, 3]


def test_a_run_whose_last_line_was_torn_goes_on(tmp_path: Path) -> None:
    append_metrics(tmp_path, {"case": "random", "epoch": 1})
    with (tmp_path / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"case": "random", "epo')
    train_argate.forget_from(tmp_path, "random", 2)
    append_metrics(tmp_path, {"case": "random", "epoch": 2})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in lines] == [1, 2]


TINY = {
    "3.1": (
        "Made up",
        (
            Row(
                "n_clean=1 uniform",
                {"dataset": "simulated", "protocol": "random", "n_clean": 1, "epochs": 2},
                channel="sensor_2",
            ),
        ),
    )
}


@pytest.mark.slow
def test_reproduce_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fusion_tables, "TABLES", TINY)
    config = reproduce.Config(
        table=("3.1",),
        preset="quick",
        seeds=1,
        models=("argate_l",),
        out=tmp_path / "runs",
        results=tmp_path / "results",
    )
    reproduce.main(config)
    assert "result: tables=3.1 runs=1" in capsys.readouterr().out
    table = json.loads((tmp_path / "results" / "table_3_1.json").read_text())
    cell = next(row for row in table["rows"] if row["metric"] == "accuracy")
    source = json.loads((repository.RESULTS / "source_tables.json").read_text())["3.1"]
    assert cell["source"] == source["rows"]["n_clean=1 uniform"][-1]
    path = tmp_path / "runs" / "3.1" / "n_clean=1_uniform" / "argate_l" / "0.json"
    record = json.loads(path.read_text())
    assert cell["values"] == [record["accuracy"]]
    corrupted = round(1024 * 2 / 3)
    weights = record["channel"]
    assert len(weights["when_failed"]) + len(weights["when_clean"]) in (corrupted, corrupted + 1)

    reproduce.main(config)
    assert "runs=0" in capsys.readouterr().out
    assert json.loads(path.read_text()) == record


@pytest.mark.parametrize("shard", ["2/2", "a", "1"])
def test_shards_are_checked(shard: str) -> None:
    with pytest.raises(ValueError, match=f"shard='{shard}'"):
        reproduce.main(reproduce.Config(shard=shard))
    with pytest.raises(ValueError, match=r"\['9.9'\] are not known; known: 2.3"):
        reproduce.main(reproduce.Config(table=("9.9",)))


def test_every_run_has_a_file_and_a_number_of_the_source() -> None:
    source = json.loads((repository.RESULTS / "source_tables.json").read_text())
    paths = []
    for table, (_, rows) in fusion_tables.TABLES.items():
        assert [row.name for row in rows] == list(source[table]["rows"])
        paths += [run.path(Path()) for run in fusion_tables.runs(table, 2)]
    # Rows x models and references, for two seeds.
    assert len(set(paths)) == len(paths) == 2 * (65 + 16 + 24 + 18 + 65 + 8)


def test_every_row_stands_between_a_trivial_opponent_and_a_bound() -> None:
    for table, (_, rows) in fusion_tables.TABLES.items():
        for row in rows:
            assert ("equal_weights" in row.models) == (row.settings["dataset"] == "driver")
            if "gaussian" not in row.name:
                assert set(fusion_tables.TRIVIAL) <= set(row.models), (table, row.name)
            if row.name != "clean":  # where nothing fails a gate has nothing to be told
                assert "oracle" in row.models, (table, row.name)


def test_the_baseline_of_the_new_head_carries_the_sources_baseline(tmp_path: Path) -> None:
    row = fusion_tables.TABLES["3.6"][1][0]
    record = dict.fromkeys(fusion_tables.METRICS, 0.5)
    write_json(Run("3.6", row, "equal_weights", 0).path(tmp_path), record)
    source = json.loads((repository.RESULTS / "source_tables.json").read_text())
    rows, _ = fusion_tables.collect("3.6", tmp_path, 1, source)
    (cell,) = [r for r in rows if r["metric"] == "accuracy"]
    assert cell["source"] == source["3.6"]["rows"][row.name][0]


def test_a_table_pairs_runs_by_seed(tmp_path: Path) -> None:
    accuracy = {
        "baseline": [60.0, 70.0, 65.0],
        "argate_plus": [64.0, 75.0, 68.0],
        "argate_l": [64.0, 76.0],
        "embracenet": [58.0],
    }
    row = fusion_tables.TABLES["3.1"][1][5]
    for model, values in accuracy.items():
        for seed, value in enumerate(values):
            record = dict.fromkeys(fusion_tables.METRICS, 0.5) | {"accuracy": value}
            if model == "baseline":
                record["gate_auroc_pooled"] = None
            write_json(Run("3.1", row, model, seed).path(tmp_path), record)
    source = json.loads((repository.RESULTS / "source_tables.json").read_text())
    rows, studies = fusion_tables.collect("3.1", tmp_path, 3, source)
    held = {(r["model"], r["metric"]): r for r in rows}
    assert held["argate_plus", "accuracy"]["mean"] == 69.0
    assert held["argate_plus", "accuracy"]["source"] == source["3.1"]["rows"][row.name][3]
    assert held["embracenet", "accuracy"]["ci95"] is None
    assert "source" not in held["embracenet", "accuracy"]
    assert ("baseline", "gate_auroc_pooled") not in held
    found = {s["comparison"]: s for s in studies}
    assert found["argate_plus - baseline"]["difference"] == 4.0
    # Only the two seeds that both have.
    assert found["argate_l - argate_plus"]["difference"] == 0.5
    assert found["argate_l - argate_plus"]["n"] == 2


def test_the_study_changes_one_setting_at_a_time(tmp_path: Path) -> None:
    listed = study_argate.variants(study_argate.Config())
    assert len(listed) <= 24
    assert len({v.path(tmp_path) for v in listed}) == len(listed)
    data, config = load("simulated"), dataclasses.replace(SMALL, epochs=None)
    base = build_settings(config, data), build_cases(config, data)["random"].noise
    assert study_argate.change(*base, {}) == base
    for variant in listed:
        # Every change changes something, and can be built.
        assert (study_argate.change(*base, dict(variant.changes)) == base) == (
            not variant.changes
        ), variant
    with pytest.raises(ValueError, match=r"changes=\['depth'\]: expected some of normalizer"):
        study_argate.change(*base, {"depth": 3})
    with pytest.raises(ValueError, match=r"models=\['oracle'\]: expected some of baseline"):
        study_argate.variants(study_argate.Config(models=("oracle",)))


def test_the_study_collects_what_is_there(tmp_path: Path) -> None:
    config = study_argate.Config(
        models=("argate_ws", "baseline"),
        seeds=2,
        out=tmp_path / "runs",
        results=tmp_path,
        collect_only=True,
    )
    for i, variant in enumerate(study_argate.variants(config)[:4]):
        record = dict.fromkeys(fusion_tables.METRICS, 0.5) | {"accuracy": 70.0 + i}
        write_json(variant.path(config.out), record)
    study_argate.main(config)
    rows = json.loads((tmp_path / "study_argate.json").read_text())["rows"]
    accuracy = {(r["row"], r["model"]): r["values"] for r in rows if r["metric"] == "accuracy"}
    assert accuracy == {
        ("har: preset", "baseline"): [70.0, 73.0],
        ("har: redraw=False", "baseline"): [71.0],
        ("har: preset", "argate_ws"): [72.0],
    }


@pytest.mark.slow
def test_a_folder_of_csv_files_is_trained_on(tmp_path: Path) -> None:
    folder = repository.ROOT / "examples" / "own_sensors"
    config = Config(data=folder, model="netgated", epochs=2, out=tmp_path / "run")
    summary = train_argate.main(config)
    lines = (tmp_path / "run" / "predictions.csv").read_text().splitlines()
    assert lines[0] == "id,predicted,failed" and len(lines) == 1 + summary["rows"]["test"]
    assert {line.split(",")[1] for line in lines[1:]} <= {"walk", "run"}
    assert any(line.endswith(",imu") for line in lines)
    assert 0.0 <= summary["scores"]["accuracy_corrupted"] <= 100.0
    fitted = FittedSensors.load(tmp_path / "run" / "model.npz")
    ids, windows = read_windows(folder, dict(zip(fitted.sensors, fitted.channels, strict=True)))
    told = dict(zip(ids, fitted.predict(windows).output.argmax(1), strict=True))
    whole = [line.split(",") for line in lines[1:] if line.endswith(",")]  # no sensor failed
    assert whole and all(fitted.names[told[name]] == said for name, said, _ in whole)


def test_which_networks_are_kept(tmp_path: Path) -> None:
    own = Config(data=tmp_path / "my.npz", model="netgated")
    both = {name: tmp_path / f"model_{name}.npz" for name in ("clean", "random")}
    assert network_files(own, ["clean", "random"], tmp_path) == both
    assert "FittedARGate.load" in kept_sentence(both, "test")
    assert network_files(own, ["random"], tmp_path) == {"random": tmp_path / "model.npz"}
    assert network_files(dataclasses.replace(own, model="oracle"), ["random"], tmp_path) == {}
    assert network_files(SMALL, ["random"], tmp_path) == {}


def test_options_of_equal_windows_are_refused_for_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"head='dense': not read with --data FOLDER"):
        train_argate.main(Config(data=tmp_path, head="dense"))
    with pytest.raises(ValueError, match="expected clean or random"):
        train_argate.main(Config(data=tmp_path, protocol="fixed"))
