"""The report page: marks, missing tables and figures, and markup that stands on its own."""

from __future__ import annotations

import dataclasses
import html.parser
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from snn_fusion_failure.records import cells, chapters, comparability, intervals, report
from snn_fusion_failure.records.figures import FIGURES
from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import repository, write_json
from tests._scripts import load_script

reproduce = load_script("studies/reproduce")
render_results = load_script("studies/render_results")

VOID = {"meta", "img", "br", "hr", "link", "input"}
# One transparent pixel.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010804000000b51c0c020000000b4944415478da6364"
    "f80f00010501012718e3660000000049454e44ae426082"
)


class Page(html.parser.HTMLParser):
    """Checks nesting; keeps the cells of every table row, ids, links and addresses."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.rows: list[list[str]] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.alternatives: list[str | None] = []
        self.section = ""
        self.sections: dict[str, list[list[str]]] = {}
        self.feed(text)
        self.close()
        assert not self.stack, f"not closed: {self.stack}"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        if given.get("id"):
            self.ids.append(str(given["id"]))
            self.section = self.ids[-1]
        self.addresses += [str(v) for k, v in attributes if k in ("src", "href", "data")]
        if tag == "img":
            self.alternatives.append(given.get("alt"))
        if tag == "tr":
            self.rows.append([])
            self.sections.setdefault(self.section, []).append(self.rows[-1])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.stack and self.stack[-1] == tag, f"</{tag}> closes {self.stack[-3:]}"
        self.stack.pop()

    def handle_data(self, data: str) -> None:
        if {"td", "th"} & set(self.stack):
            self.rows[-1][-1] += data


def _row(row: str, model: str, metric: str, values: list[Any], **more: Any) -> dict[str, Any]:
    return {"row": row, "model": model, "metric": metric, "unit": "%"} | summarize(values) | more


def _write(folder: Path, table: str, rows: list[dict[str, Any]]) -> None:
    content = {"table": table, "title": "made up", "preset": "paper", "git": "abc1234",
               "command": "python scripts/x.py --a <b>", "versions": {"jax": "9"},
               "device": "cpu", "date": "2026-01-02", "rows": rows}  # fmt: skip
    write_json(folder / f"table_{table.replace('.', '_')}.json", content)


HITS: list[Any] = [150.0, 160.0, 170.0, 180.0, 190.0, None, None]


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    # Marks and their absence in one small table: as if success were measured as in the source.
    moves = comparability.Difference(("2.3",), "the source's maps are lost", metric="n_mv")
    others = [d for d in comparability.DIFFERENCES if "2.3" not in d.tables]
    monkeypatch.setattr(comparability, "DIFFERENCES", (moves, *others))
    record, fresh = tmp_path / "results", tmp_path / "run" / "results"
    # The source: S4 in testing 100, S1 70; steering movements S4 46, S1 50.
    _write(record, "2.3", [
        _row("Scenario 1", "S4", "sr_testing", [90.0, 91.0, 92.0]),
        _row("Scenario 1", "S1", "sr_testing", [60.0, 70.0, 81.0]),
        _row("Scenario 1", "S4", "n_mv", [40.0, 41.0, 42.0]),
        _row("Scenario 1", "S1", "n_mv", [60.0, 61.0, 62.0]),
        _row("Scenario 1", "S1 <literal>", "sr_testing", [1.0, 2.0]),
    ])  # fmt: skip
    _write(fresh, "2.3", [_row("Scenario 1", "S4", "sr_testing", [100.0])])
    hits = _row("undershoot (box)", "HDBO", "first_failure_hit", [1.0, 2.0]) | {
        "n": 7, "values": HITS,
    }  # fmt: skip
    none = hits | {"model": "Rev-ARGate zeros", "n": 6, "values": [None] * 6, "mean": None}
    worst = _row("undershoot (box)", "HDBO", "worst_case", [0.8, 0.9], unit="V")
    _write(record, "4.1", [hits, none, worst])
    images = tmp_path / "docs" / "images"
    images.mkdir(parents=True)
    (images / "snn_stdp.png").write_bytes(PNG)
    trend = tmp_path / "run" / "4.1" / "ldo" / "undershoot" / "box" / "trend.png"
    trend.parent.mkdir(parents=True)
    trend.write_bytes(PNG)
    return {"record": record, "fresh": fresh, "root": tmp_path}


def _page(folders: dict[str, Path]) -> tuple[str, Page]:
    path = report.write(folders["root"] / "report", **folders)
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def _line(page: Page, section: str, heading: str, *start: str) -> list[list[str]]:
    """Rows under a heading line of a table that begin so."""
    found, inside = [], False
    for row in page.sections[section]:
        if len(row) == 1:
            inside = row[0].startswith(heading)
        elif inside and tuple(row[: len(start)]) == start:
            found.append(row)
    return found


def test_marks_origins_and_directions(folders: dict[str, Path]) -> None:
    text, page = _page(folders)
    testing = "Scenario 1: success rate in testing [%], higher is better"
    (quick,) = _line(page, "table-2.3", testing, "S4 (quick)")
    (record,) = _line(page, "table-2.3", testing, "S4")
    assert quick[1:4] == ["100", "100.00", "≈ within"] and quick[-2:] == ["1", "quick run"]
    assert quick[4] == "no interval"
    assert record[1:4] == ["100", "91.00", "✗ worse"] and record[-2:] == ["3", "record"]
    assert record[4] == "88.20 to 93.19"
    (within,) = _line(page, "table-2.3", testing, "S1", "70")
    assert within[3] == "≈ within"
    movements = "Scenario 1: steering movements until arrival [steps], lower is better"
    # Lower is better, but on other maps.
    assert _line(page, "table-2.3", movements, "S4")[0][3] == "– not comparable"
    assert "source&#x27;s maps are lost" in text
    (missing,) = _line(page, "table-2.3", movements, "S2")
    assert missing[1:4] == ["49", "", "○ not run"]
    # Not of the source: in the second table, without a mark.
    (literal,) = _line(page, "table-2.3", testing.split("[")[0], "S1 <literal>")
    assert literal[1] == "1.50" and "record" in literal[-1]


def test_first_failure_is_a_median_and_other_circuits_are_no_peers(
    folders: dict[str, Path],
) -> None:
    _, page = _page(folders)
    (hit,) = _line(page, "table-4.1", "undershoot (box): simulations until", "HDBO")
    # Between the smallest and the largest of seven, which is "none".
    peer = "– not comparable"
    assert hit[1:5] == ["221", "180", peer, "150 to none found; found in 5 of 7"]
    (zeros,) = _line(page, "table-4.1", "undershoot (box): simulations until", "Rev-ARGate zeros")
    assert zeros[1:5] == ["262", "none found", peer, "none found; found in 0 of 6"]
    (worst,) = _line(page, "table-4.1", "undershoot (box): worst case", "HDBO")
    assert worst[1:4] == ["0.36 V", "0.85", peer]
    (dash,) = _line(page, "table-4.1", "undershoot (box): simulations until", "pBO")
    assert dash[1] == "none in 300" and dash[3] == "○ not run"


def test_tables_and_figures_that_are_not_there(folders: dict[str, Path]) -> None:
    text, page = _page(folders)
    sources = chapters.source_tables()
    assert {f"table-{n}" for n in sources if n != "source"} <= set(page.ids)
    assert {f"figure-{f.number}" for f in FIGURES} <= set(page.ids)
    rows = [row for row in page.sections["table-3.1"] if len(row) == 7][1:]
    assert len(rows) == 35 and {row[3] for row in rows} == {"○ not run"}
    assert "which its makers keep" in text
    assert text.count("data:image/png;base64,") == 2 == len(page.alternatives)
    assert text.count("○ not run</div>") == len(FIGURES) - 2
    assert all(page.alternatives)
    overview = {tuple(row[:2]): row[2:] for row in page.sections[""] if len(row) == 7}
    assert overview["2.3", "quick run"] == ["·", "1", "·", "·", "14"]
    assert overview["2.3", "record"] == ["·", "1", "1", "2", "11"]
    assert overview["2.4", "–"][-1] == "15"
    assert overview["all", "record"][:4] == ["·", "1", "1", "5"]


def test_page_needs_nothing_else(folders: dict[str, Path]) -> None:
    text, page = _page(folders)
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in page.addresses)
    assert {a[1:] for a in page.addresses if a.startswith("#")} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    assert "http:" not in text and "https:" not in text and "@import" not in text
    assert "<script" not in text and "url(" not in text
    assert "--a &lt;b&gt;" in text  # the command of record, escaped
    details = page.sections["details"]
    assert any(row[:2] == ["Table 2.3", "record"] and "abc1234" in row for row in details)


def test_an_empty_folder_still_gives_a_page(tmp_path: Path) -> None:
    empty = {"record": tmp_path / "a", "fresh": tmp_path / "b" / "c", "root": tmp_path}
    _, page = _page(empty)
    assert not page.alternatives and "table-4.2" in page.ids


def test_a_broken_table_is_named(folders: dict[str, Path]) -> None:
    (folders["record"] / "table_3_1.json").write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match=r"table_3_1\.json is no table of record"):
        _page(folders)


def test_every_number_of_the_source_is_a_cell() -> None:
    def leaves(value: Any) -> int:
        if isinstance(value, dict | list):
            return sum(map(leaves, value.values() if isinstance(value, dict) else value))
        return 1

    for number, table in chapters.source_tables().items():
        if number == "source":
            continue
        found = cells.printed_cells(number, table)
        assert len(found) == leaves(table["rows"]), number
        keys = {(c.row, c.model, c.metric) for c in found}
        assert len(keys) == len(found), number
    assert cells.printed_cells("4.2", chapters.source_tables()["4.2"])[4].scale == 1e3


def test_names_of_record_meet_the_source() -> None:
    """A misspelt row would show as not run beside a row that the source has not."""
    sources = chapters.source_tables()
    for number, table in cells.load_tables(repository.RESULTS).items():
        if number.startswith("3.") and number not in chapters.NOT_RUNNABLE:
            found, _ = cells.join(number, sources[number], [("record", table)])
            assert cells.tally(found, "record")["not run"] == 0, number


def test_median_interval() -> None:
    # n = 20: ranks 6 and 15 hold the median with 95.86 %; n = 5 cannot.
    assert intervals.median_interval([float(v) for v in range(1, 21)]) == (6.0, 15.0)
    assert intervals.median_interval([1.0] * 5) is None
    assert intervals.median_interval([3.0, 1.0, 2.0, 5.0, 4.0, math.inf]) == (1.0, math.inf)


def test_a_difference_gives_no_mark() -> None:
    printed = cells.Printed("a", "b", "n_mv", "steps", 46.0, "46", reason="other maps")
    ours = cells.Measured(23.0, (22.0, 24.0), 64, "", "record")
    assert cells.verdict(printed, ours) is None
    assert cells.verdict(dataclasses.replace(printed, reason=""), ours) == "better"


def test_differences_name_cells_of_the_source() -> None:
    sources = chapters.source_tables()
    for one in comparability.DIFFERENCES:
        for number in one.tables:
            found = cells.printed_cells(number, sources[number])
            names = [{"row": c.row, "model": c.model, "metric": c.metric} for c in found]
            assert any(one.holds(number, name) for name in names), (number, one)


def test_no_failure_in_the_source_is_later_than_any() -> None:
    printed = cells.Printed("a", "b", "first_failure_hit", "", None, "none in 300")
    ours = cells.Measured(60.0, (55.0, 70.0), 20, "", "record", "median")
    assert cells.verdict(printed, ours) == "better"
    assert cells.verdict(printed, dataclasses.replace(ours, kind="mean")) is None
    none = dataclasses.replace(ours, centre=math.inf, interval=(55.0, math.inf))
    assert cells.verdict(printed, none) == "within"
    late = dataclasses.replace(printed, value=40.0)
    assert cells.verdict(late, none) == "worse"


def test_report_only_runs_nothing(tmp_path: Path, folders: dict[str, Path]) -> None:
    config = reproduce.Config(report_only=True, report=tmp_path / "page", results=folders["fresh"])
    assert reproduce.main(config) == {}
    assert "quick run" in (tmp_path / "page" / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"table": ("3.8",)}, "table 3.8 needs the labels"),
        ({"table": ("9.1",)}, r"tables \['9.1'\] are not known; known: 2.3"),
        ({"shard": "2/2"}, "expected 0 <= i < n"),
        ({"overwrite": True}, "overwrite is for quick runs"),
    ],
)
def test_bad_input(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    config = dataclasses.replace(reproduce.Config(out=tmp_path, report=tmp_path), **change)
    with pytest.raises(ValueError, match=message):
        reproduce.main(config)
    assert not list(tmp_path.iterdir())


def test_collecting_from_single_runs(tmp_path: Path) -> None:
    """Runs of Table 3.1 on disk become a table and a mark on the page; nothing is trained."""
    run = next(iter(chapters.fusion_tables.runs("3.1", 1)))
    record = dict.fromkeys(chapters.fusion_tables.METRICS, 99.0)
    write_json(run.path(tmp_path / "out"), record)
    config = reproduce.Config(
        table=("3.1", "2.4", "4.2"), preset="quick", out=tmp_path / "out", report=tmp_path / "page",
        collect_only=True,
    )  # fmt: skip
    written = reproduce.main(config)
    assert list(written) == ["3.1"] and written["3.1"][0]["source"] == 94.06
    held = json.loads((tmp_path / "out" / "results" / "table_3_1.json").read_text())
    assert held["preset"] == "quick"
    page = Page((tmp_path / "page" / "index.html").read_text(encoding="utf-8"))
    (line, *_) = _line(page, "table-3.1", "clean: accuracy [%]", "Baseline (quick)")
    assert line[1:4] == ["94.06", "99.00", "✓ better"] and line[-1] == "quick run"


def test_seeds_of_record_are_not_run_again(tmp_path: Path) -> None:
    """A new machine has the tables and not the runs: what they hold comes back, with its commit."""
    out, results = tmp_path / "out", tmp_path / "results"
    first, *_ = (r for r in chapters.fusion_tables.runs("3.1", 1) if r.row.robustness)
    kinds = dict.fromkeys(chapters.fusion_tables.UNSEEN_KINDS, 80.0)
    for seed in (0, 1):
        run = dataclasses.replace(first, seed=seed)
        scores = dict.fromkeys(chapters.fusion_tables.METRICS, 90.0 + seed)
        write_json(run.path(out), scores | {"git": "abc", "robustness": kinds})
    config = reproduce.Config(
        table=("3.1",), seeds=3, out=out, results=results, report=tmp_path / "page",
        collect_only=True, restore=True,
    )  # fmt: skip
    before = reproduce.main(config)["3.1"]
    unseen = render_results.collect_unseen_kinds(render_results.Config(runs=out))
    write_json(results / "study_unseen_kinds.json", {"rows": unseen})
    shutil.rmtree(out)
    newer = dict.fromkeys(chapters.fusion_tables.METRICS, 92.0) | {"git": "def"}
    write_json(dataclasses.replace(first, seed=2).path(out), newer)
    after = reproduce.main(config)["3.1"]
    assert [row["values"] for row in before] == [[90.0, 91.0]] * len(before)
    for row in after:
        assert row["values"] == [90.0, 91.0, 92.0] and row["seeds"] == [0, 1, 2]
        assert row["git"] == "abc, def"
    assert len(after) == len(before) == len(chapters.fusion_tables.METRICS)
    assert render_results.collect_unseen_kinds(render_results.Config(runs=out)) == unseen


def test_models_of_other_chapters_start_no_search(tmp_path: Path) -> None:
    plan = chapters.Plan(preset="quick", results=tmp_path, out=tmp_path, models=("S4", "baseline"))
    assert chapters.failures(plan, ("4.1", "4.2")) == ({}, 0)
    assert not any(tmp_path.iterdir())


def test_times_of_the_tables_are_kept(tmp_path: Path) -> None:
    config = reproduce.Config(table=("4.1",), preset="quick", models=("S4",), out=tmp_path)
    assert reproduce.main(config) == {}
    times = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    for kind in ("seconds", "cpu_seconds"):
        assert set(times[kind]) == {"4.1"} and times[kind]["4.1"] >= 0.0


@pytest.mark.slow
@pytest.mark.relaxed  # the optimizer's own promotions
def test_without_har_the_quick_piece_says_that_it_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("FUSION_DATA_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    plan = chapters.Plan(
        preset="quick", results=tmp_path / "results", piece=True, models=("baseline",),
        data_dir=tmp_path, out=tmp_path,
    )  # fmt: skip
    written, runs = chapters.sensor_fusion(plan, ("3.1",))
    assert runs == 1 and "simulated windows instead of HAR" in capsys.readouterr().err
    assert all(
        row["row"].startswith("simulated windows (HAR not at hand)") for row in written["3.1"]
    )
    assert not any("source" in row for row in written["3.1"])
    _, page = _page({"fresh": tmp_path / "results", "record": tmp_path / "none", "root": tmp_path})
    heading = "simulated windows (HAR not at hand), 1 clean channel, uniform noise: accuracy [%]"
    assert len(_line(page, "table-3.1", heading, "Baseline")) == 1
    assert chapters.sensor_fusion(plan, ("3.1",))[1] == 0
