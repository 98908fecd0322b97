"""Bookkeeping of the scripts: whole files, refusals, intervals, tables that grow."""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from snn_fusion_failure.records.rows import Compared, record_table, recorded, summarize
from snn_fusion_failure.runs import (
    WorkFailedError,
    append_metrics,
    command_line,
    fail,
    open_run,
    print_result,
    repository,
    run_command,
    write_json,
    write_text,
)

# The package's own `provenance` is the function of that name.
made_by = importlib.import_module("snn_fusion_failure.runs.origin")
folder = importlib.import_module("snn_fusion_failure.runs.folder")


@dataclasses.dataclass(frozen=True)
class Settings:
    model: str = "a"
    epochs: int = 3
    folder: Path = Path("x")


def test_write_text_leaves_the_old_file_when_writing_fails(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.json"
    write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \udc80")  # a lone surrogate cannot be written
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["file.json"]


def test_json_values(tmp_path: Path) -> None:
    value = {
        "settings": Settings(),
        "array": np.asarray([1.5, np.nan], np.float32),
        "scalar": np.float64(2.0),
        "infinite": float("inf"),
        3: {"set": {7}},
    }
    write_json(tmp_path / "v.json", value)
    assert json.loads((tmp_path / "v.json").read_text()) == {
        "settings": {"model": "a", "epochs": 3, "folder": "x"},
        "array": [1.5, None],
        "scalar": 2.0,
        "infinite": None,
        "3": {"set": [7]},
    }


def test_metrics_are_one_line_each(tmp_path: Path) -> None:
    for epoch in range(2):
        append_metrics(tmp_path / "run", {"epoch": epoch, "loss": np.float32(0.5)})
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [{"epoch": e, "loss": 0.5} for e in range(2)]


def test_a_run_folder_is_claimed_once(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert open_run(out, Settings()) == {"model": "a", "epochs": 3, "folder": "x"}
    held = json.loads((out / "config.json").read_text())
    assert held["settings"]["epochs"] == 3
    assert {"command", "git", "versions", "device", "date"} <= set(held)
    with pytest.raises(ValueError, match=r"already holds a run; pass --resume .* --overwrite"):
        open_run(out, Settings())
    open_run(out, Settings(), resume=True)
    with pytest.raises(ValueError, match=r"other settings \(epochs: 3 -> 4; model: 'a' -> 'b'\)"):
        open_run(out, Settings("b", 4), resume=True)


@pytest.mark.parametrize("content", [b"", b'{"settings": {', b"\xe9t\xe9", b"[]", b"{}"], ids=repr)
def test_a_damaged_config_is_named_with_what_can_be_done(tmp_path: Path, content: bytes) -> None:
    open_run(tmp_path, Settings())
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json cannot be read .*--overwrite to begin"):
        open_run(tmp_path, Settings(), resume=True)
    with pytest.raises(ValueError, match="pass --resume"):
        open_run(tmp_path, Settings())
    assert (tmp_path / "config.json").read_bytes() == content
    open_run(tmp_path, Settings(), overwrite=True)
    open_run(tmp_path, Settings(), resume=True)


def test_settings_that_may_change_are_noted_where_the_run_goes_on(tmp_path: Path) -> None:
    open_run(tmp_path, Settings())
    open_run(tmp_path, Settings(epochs=5), resume=True, may_change=("epochs",))
    held = json.loads((tmp_path / "config.json").read_text())
    assert held["settings"]["epochs"] == 3 and held["resumed"][0]["settings"] == {"epochs": 5}
    with pytest.raises(ValueError, match=r"other settings \(model: 'a' -> 'b'\)"):
        open_run(tmp_path, Settings("b", 5), resume=True, may_change=("epochs",))


def test_a_resumed_run_keeps_who_made_its_beginning(tmp_path, monkeypatch) -> None:
    open_run(tmp_path, Settings())
    first = json.loads((tmp_path / "config.json").read_text())
    monkeypatch.setattr(folder, "provenance", lambda: {"git": "later", "command": "again"})
    open_run(tmp_path, Settings(), resume=True)
    held = json.loads((tmp_path / "config.json").read_text())
    assert {k: held[k] for k in first} == first
    assert held["resumed"] == [{"git": "later", "command": "again"}]


def test_results_of_record_refuse_changed_code(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(repository, "RECORD", tmp_path)
    monkeypatch.setattr(made_by, "changed_code", lambda: ["fusion/train.py"])
    monkeypatch.delenv(made_by.ALLOW_DIRTY, raising=False)
    path, row = tmp_path / "table_9_9.json", {"row": "r", "model": "m", "metric": "x", "mean": 1.0}
    with pytest.raises(ValueError, match=r"fusion/train\.py changed; commit first.*kept in runs"):
        record_table(path, "9.9", "T", [row], preset="paper")
    assert not path.exists()
    kept = json.loads((tmp_path / "runs" / "refused" / path.name).read_text())["rows"]
    assert kept[0]["mean"] == 1.0
    monkeypatch.setenv(made_by.ALLOW_DIRTY, "1")
    record_table(path, "9.9", "T", [row], preset="paper")
    found = json.loads(path.read_text())
    assert found["git"].endswith("-dirty") and found["rows"][0]["git"].endswith("-dirty")
    monkeypatch.setattr(repository, "IS_CHECKOUT", False)
    with pytest.raises(ValueError, match="expected a checkout"):
        repository.require_checkout("--record")


def test_work_that_failed_is_missing_or_interrupted_has_its_exit_status(capsys) -> None:
    def leave(found) -> int:
        def main(_: Settings) -> Any:
            if isinstance(found, BaseException):
                raise found
            return found

        try:
            run_command(Settings, main, description=None, fields=dict, argv=[], prog="x")
        except SystemExit as left:
            return left.code
        return 0

    assert leave({"failed": 0, "missing": 0}) == 0
    assert leave({"failed": 3}) == leave({"missing": 1}) == 1
    assert leave(ValueError("bad")) == 2
    assert leave(WorkFailedError("half")) == 1
    capsys.readouterr()
    assert leave(KeyboardInterrupt()) == 130
    assert capsys.readouterr().err.startswith("interrupted: what was finished is kept")


def test_overwrite_forgets_the_old_numbers(tmp_path: Path) -> None:
    open_run(tmp_path, Settings())
    for name in ("metrics.jsonl", "result.json", "kept.txt"):
        (tmp_path / name).write_text("old")
    open_run(tmp_path, Settings("b"), overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "kept.txt"]
    held = json.loads((tmp_path / "config.json").read_text())
    assert held["settings"]["model"] == "b"


@pytest.mark.parametrize("n", [2, 3, 5, 10, 31])
def test_interval_is_student_s(n: int) -> None:
    values = np.random.default_rng(n).normal(70.0, 2.0, n)
    summary = summarize(values.tolist())
    low, high = stats.t.interval(0.95, n - 1, values.mean(), stats.sem(values))
    assert summary["n"] == n
    np.testing.assert_allclose(summary["mean"], values.mean(), rtol=1e-12)
    np.testing.assert_allclose(summary["ci95"], [low, high], rtol=1e-4)
    assert summary["values"] == values.tolist()


def test_one_run_has_no_interval() -> None:
    assert summarize([4.0]) == {"n": 1, "mean": 4.0, "ci95": None, "values": [4.0]}


def test_a_table_that_grows_compares_the_columns_of_earlier_commands_too(tmp_path: Path) -> None:
    path = tmp_path / "study_x.json"
    compared = [
        Compared("accuracy", (("b", "a"), ("c", "a"))),
        Compared("auroc", (("b", "a"),), 100),
    ]

    def record(**columns: tuple[float, ...]) -> list[dict[str, Any]]:
        rows = [
            {"row": "clean", "model": model, "metric": metric, "seeds": list(range(len(values)))}
            | {"values": [scale * v for v in values]}
            for model, values in columns.items()
            for metric, scale in (("accuracy", 1.0), ("auroc", 0.01))
        ]
        record_table(path, "x", "X", rows, preset="paper", compared=compared)
        return list(json.loads(path.read_text()).get("comparisons", []))

    assert record(a=(1.0, 2.0, 3.0)) == []
    (first, auroc) = record(b=(2.0, 4.0, 6.0))
    assert first["comparison"] == "b - a" and first["p_holm"] == pytest.approx(2 * first["p_value"])
    assert auroc["row"] == "clean, auroc" and auroc["difference"] == pytest.approx(2.0)
    found = record(c=(0.0, 0.0))
    assert [pair["comparison"] for pair in found] == ["b - a", "c - a", "b - a"]
    # Common seeds alone: 0 - 1 and 0 - 2; the smallest of three p values.
    assert found[1]["difference"] == pytest.approx(-1.5)
    assert found[0]["p_holm"] == pytest.approx(3 * first["p_value"])


def test_rows_without_a_command_keep_that_of_their_file_when_it_grows(tmp_path: Path) -> None:
    path, row = tmp_path / "study_x.json", {"row": "r", "model": "m", "metric": "x", "mean": 1.0}
    held = {"command": "python old.py", "git": "abc", "rows": [row]}
    path.write_text(json.dumps(held), encoding="utf-8")
    record_table(path, "x", "X", [row | {"row": "other"}], preset="paper")
    old, new = recorded(path)
    assert (old["command"], old["git"]) == ("python old.py", "abc")
    assert new["row"] == "other" and new["command"] != "python old.py"


def test_a_table_grows_and_is_corrected(tmp_path: Path) -> None:
    path = tmp_path / "table_3_1.json"

    def row(model: str, mean: float, metric: str = "accuracy") -> dict[str, object]:
        return {"row": "clean", "model": model, "metric": metric, "mean": mean}

    record_table(path, "3.1", "HAR", [row("a", 1.0), row("b", 2.0)], preset="paper")
    new = [row("b", 3.0), row("b", 4.0, "gate_auroc_pooled")]
    record_table(path, "3.1", "HAR", new, preset="paper")
    held = json.loads(path.read_text())
    bare = [{k: v for k, v in r.items() if k not in ("command", "git")} for r in held["rows"]]
    assert bare == [row("a", 1.0), *new]
    assert all(r["command"].startswith("python ") for r in held["rows"])
    assert (held["table"], held["title"], held["preset"]) == ("3.1", "HAR", "paper")
    assert {"command", "git", "versions", "device", "date"} <= set(held)


def test_the_command_names_no_folder_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    script = str(repository.ROOT / "scripts" / "train_argate.py")
    monkeypatch.setattr(sys, "argv", [script, "--data-dir", "/home/me/data", "--model", "argate_l"])
    wanted = "python scripts/train_argate.py --data-dir $FUSION_DATA_DIR --model argate_l"
    assert command_line() == wanted
    monkeypatch.setattr(sys, "argv", [script, "--only", "tuned, gamma", "--out", "/home/me/runs/y"])
    assert command_line().endswith("--only 'tuned, gamma' --out PATH/y")


def test_result_line_and_failure(capsys: pytest.CaptureFixture[str]) -> None:
    print_result(model="argate_l", accuracy=97.65432, runs=3)
    assert capsys.readouterr().out == "result: model=argate_l accuracy=97.65 runs=3\n"
    with pytest.raises(SystemExit) as left:
        fail("n_clean=9")
    assert left.value.code == 2
    assert capsys.readouterr().err == "error: n_clean=9\n"


def test_earlier_shares_get_the_interval_that_they_lack(tmp_path: Path) -> None:
    """Wilson's 95 % interval of 20 of 20, by hand: 1 / (1 + 1.96^2 / 20) = 0.839."""
    path = tmp_path / "t.json"
    old = {"row": "a", "model": "m", "unit": "1", "n": 20, "mean": 1.0, "git": "1234567"}
    held = [old | {"metric": name} for name in ("coverage", "known", "coverage_90")]
    held.append(old | {"metric": "success_rate", "ci95": [0.5, 1.0]})
    write_json(path, {"rows": held})
    record_table(path, "4", "T", [old | {"metric": "first_failure_share"}], preset="paper")
    rows = {r["metric"]: r for r in recorded(path)}
    for name in ("coverage", "known", "first_failure_share"):
        assert rows[name].pop("ci95") == pytest.approx([0.839, 1.0], abs=5e-4)
    assert [rows[r["metric"]] for r in held] == held


def test_a_metric_that_a_cell_has_no_longer_goes_with_whole_cells(tmp_path: Path) -> None:
    """What ten successful runs cost stayed in the table after none succeeded any more."""
    path = tmp_path / "t.json"

    def row(model: str, metric: str, mean: float) -> dict[str, object]:
        return {"row": "window", "model": model, "metric": metric, "unit": "1", "mean": mean}

    first = [row("a", "success", 0.5), row("a", "cost", 165.0), row("b", "cost", 20.0)]
    record_table(path, "4", "T", first, preset="paper", whole_cells=True)
    record_table(path, "4", "T", [row("a", "success", 0.0)], preset="paper", whole_cells=True)
    held = {(r["model"], r["metric"]): r["mean"] for r in recorded(path)}
    assert held == {("b", "cost"): 20.0, ("a", "success"): 0.0}
    record_table(path, "4", "T", [row("b", "success", 1.0)], preset="paper")
    assert ("b", "cost") in {(r["model"], r["metric"]) for r in recorded(path)}
