"""Pages from results of record: every number on them comes from the JSON, marks and blocks fit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from snn_fusion_failure.records import comparability, intervals, markdown, pages
from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import repository, write_json
from tests._scripts import load_script

render_results = load_script("studies/render_results")

MADE = {
    "command": "python scripts/studies/reproduce.py --table 3.1",
    "preset": "paper",
    "git": "abc1234",
    "versions": {"python": "3.11.0", "jax": "0.10.2"},
    "device": "cpu: 2 cores",
    "date": "2026-01-02",
}


def _row(row: str, model: str, values: list[float], **more: Any) -> dict[str, Any]:
    base = {"row": row, "model": model, "metric": "accuracy", "unit": "%"}
    return base | summarize(values) | more


# Not in the order of the source, to see that the page is.
TABLE = MADE | {
    "table": "3.1",
    "title": "HAR",
    "rows": [
        _row("n_clean=1 uniform", "argate_l", [75.0, 77.0], source=60.0),
        _row("clean", "argate_l", [96.0, 98.0], source=96.71),
        _row("clean", "oracle", [98.0]),
        _row("clean", "baseline", [90.0, 90.2], source=94.06),
        _row("clean", "argate_l", [0.99, 1.0], metric="gate_auroc_pooled", unit="1"),
    ],
}
PAIRED = MADE | {
    "table": "3.1",
    "title": "HAR: paired comparisons",
    "rows": [
        {"row": "clean", "comparison": "argate_l - baseline", "difference": 6.9, "low": 0.5,
         "high": 13.3, "t": 20.0, "p_value": 0.0001, "n": 2},
        {"row": "clean", "comparison": "gap closure argate_l", "n": 2, "value": 0.875},
    ],
}  # fmt: skip
STUDY = MADE | {
    "table": "study_x",
    "title": "A study of steps",
    "rows": [
        {"row": "all", "model": "S4", "metric": "n_mv", "unit": "steps", "n": 3, "mean": 50.5},
        {"row": "all", "model": "S4", "metric": "sr", "unit": "%", "n": 3, "mean": 70.0},
    ],
}


@pytest.fixture
def config(tmp_path: Path) -> render_results.Config:
    results = tmp_path / "results"
    files = {"table_3_1": TABLE, "study_paired_3_1": PAIRED, "study_x": STUDY}
    for name, content in files.items():
        write_json(results / f"{name}.json", content)
    return render_results.Config(
        results=results,
        docs=tmp_path / "docs",
        readme=tmp_path / "README.md",
        runs=tmp_path / "runs",
    )


def _line(text: str, *parts: str) -> str:
    lines = [line for line in text.splitlines() if all(part in line for part in parts)]
    assert len(lines) == 1, (parts, lines)
    return lines[0]


@pytest.mark.parametrize(
    ("metric", "mean", "interval", "source", "verdict"),
    [
        ("accuracy", 97.0, [96.5, 97.5], 96.0, "better"),
        ("accuracy", 97.0, [96.5, 97.5], 97.4, "within"),
        ("accuracy", 97.0, [96.5, 97.5], 98.0, "worse"),
        ("accuracy", 97.0, None, 96.9, "better"),
        ("accuracy", 97.0, None, 97.0, "within"),
        ("n_mv", 40.0, [38.0, 42.0], 46.0, "better"),
        ("n_mv", 50.0, [48.0, 52.0], 46.0, "worse"),
        # A mean over the searches that found a failure.
        ("first_failure_hit", 120.0, None, 206, None),
    ],
)
def test_marks(metric: str, mean: float, interval: Any, source: float, verdict: str | None) -> None:
    row = {"metric": metric, "mean": mean, "ci95": interval, "source": source}
    assert markdown.mark(row) == verdict


def test_a_first_failure_is_judged_by_its_median_only() -> None:
    row = {"metric": "first_failure_hit", "mean": 120.0, "ci95": [100.0, 130.0], "source": 206}
    assert markdown.mark(row) is None
    assert markdown.mark(row, "median") == "better"
    assert markdown.mark(row | {"metric": "n_mv"}, "median") is None


def test_no_mark_without_a_number_of_the_source() -> None:
    assert markdown.mark({"metric": "accuracy", "mean": 1.0}) is None
    assert markdown.mark({"metric": "accuracy", "mean": None, "source": 2.0}) is None


def test_no_mark_where_something_else_is_measured() -> None:
    rows = [
        {"row": "Scenario 1", "model": "S4", "metric": metric, "mean": 40.0, "source": 46, "n": 9}
        for metric in ("n_mv", "sr_testing", "accuracy")
    ]
    moves, successes = comparability.annotated("2.3", rows[:2])
    assert markdown.mark(moves) is None and markdown.mark(successes) is None
    assert markdown.cell(moves).endswith("source 46, *not comparable*")
    (same,) = comparability.annotated("3.1", rows[2:])
    assert same == rows[2] and markdown.mark(same) == "worse"
    line = markdown.tally_line([moves, successes, same])
    assert line.startswith("Against 1 of the source's printed numbers: 0 better, 0 within, 1 worse")
    assert "Not comparable, 2 cells: " in line and "drawings of the source's maps are lost" in line


def test_a_study_of_the_same_cells_has_no_mark_either() -> None:
    """Q-learning stands in a study of its own, too, with the source's numbers."""
    section = pages.study_section(repository.ROOT / "docs", repository.RESULTS / "study_rl.json")
    assert section.count("*not comparable*") == 9
    assert not any(f"*{mark}*" in section for mark in ("better", "within", "worse"))
    assert "Not comparable, 9 cells: the source gives neither the rewards of its Q-learn" in section


def test_tables_of_robots_have_drivers_ppo_and_the_shortest_path_beside_them(
    tmp_path: Path,
) -> None:
    def robot(row: str, model: str, values: list[float], metric: str = "sr_testing") -> Any:
        return _row(row, model, values, metric=metric)

    files = {
        "table_2_4": [robot("Scenario 2: here", "S4", [90.0, 92.0]) | {"source": 90}],
        "study_detour": [
            robot("Scenario 1", "blind", [1.0, 3.0]),
            robot("Scenario 2", "blind", [4.0, 6.0]),
            robot("Scenario 2", "reflex_100", [7.0, 9.0]),
            robot("Scenario 2", "S4", [20.0, 30.0]),
        ],
        "study_rl": [
            robot("Scenario 2", "PPO", [98.0, 99.0]) | {"source": 1},
            robot("Scenario 2", "PPO", [40.0, 42.0], "trials_to_90"),
        ],
        "study_families": [robot("Scenario 2", "planner", [377.0], "path_shortest")],
    }
    for name, rows in files.items():
        write_json(tmp_path / f"{name}.json", MADE | {"table": "2.4", "title": "T", "rows": rows})
    section = pages.table_section(tmp_path, tmp_path / "table_2_4.json", {})
    assert _line(section, "| model |") == "| model | sr_testing | path |"
    assert "**5.00**" in _line(section, "| blind |") and "**8.00**" in _line(
        section, "reflex 100 |"
    )
    assert "**98.50**" in _line(section, "| PPO |") and "source" not in _line(section, "| PPO |")
    assert "**91.00**" in _line(section, "| S4 |")  # of the table, not of the study
    assert _line(section, "| shortest path |") == "| shortest path |  | **377.00** % (1) |"
    assert (
        "On the same map: blind, reflex 100 from `results/study_detour.json`; PPO from "
        "`results/study_rl.json`; shortest path from `results/study_families.json`."
    ) in section
    assert "Not comparable, 1 cells" in section
    other = MADE | {"table": "3.1", "title": "T", "rows": files["table_2_4"]}
    write_json(tmp_path / "table_3_1.json", other)
    assert "blind" not in pages.table_section(tmp_path, tmp_path / "table_3_1.json", {})


def test_intervals_of_shares_stay_inside() -> None:
    """Student's interval of these success rates ends at 102 %."""
    row = {"metric": "sr_testing", "unit": "%", "values": [100.0] * 7 + [90.0]}
    low, high = intervals.interval(row | {"ci95": [95.8, 102.0]})
    assert 80.0 < low < 95.8 and 98.75 < high < 100.0
    # In the middle it is Student's.
    middle = [52.0, 48.0, 51.0, 49.0, 50.0]
    student = summarize(middle)["ci95"]
    assert intervals.share_interval(middle, 100.0) == pytest.approx(student, abs=0.05)
    # All have succeeded: as many trials as runs; a share of another kind has a point.
    assert intervals.share_interval([100.0] * 20, 100.0, successes=True)[0] == pytest.approx(
        83.89, abs=0.01
    )
    assert intervals.share_interval([1.0, 1.0], 1.0) == (1.0, 1.0)
    assert intervals.interval({"metric": "n_mv", "unit": "steps", "ci95": [1, 120]}) == (1, 120)


def test_nothing_of_record_is_shown_beyond_its_bounds() -> None:
    for path in (*pages.files(repository.RESULTS)[0], *pages.files(repository.RESULTS)[1]):
        for row in pages.load(path).get("rows", []):
            top = intervals.bound(row["metric"], row.get("unit")) if "metric" in row else None
            ends = intervals.interval(row) if top else None
            if ends is not None:
                assert 0.0 <= ends[0] <= row["mean"] + 1e-9, (path.name, row["metric"])
                assert row["mean"] - 1e-9 <= ends[1] <= top, (path.name, row["metric"])


def test_page(config: render_results.Config) -> None:
    config.readme.write_text("# top\n<!-- results:begin -->\nold\n<!-- results:end -->\nbottom\n")
    made = render_results.main(config)
    page = (config.docs / "results.md").read_text()
    assert made["figure"] is None  # no single runs at hand
    assert "Against 3 of the source's printed numbers: 1 better, 1 within, 1 worse." in page
    clean = _line(page, "| clean | **90.10**")
    low, high = intervals.share_interval([90.0, 90.2], 100.0)
    assert f"**90.10** [{low:.2f}, {high:.2f}] (2)<br>source 94.06, *worse*" in clean
    assert "source 96.71, *within*" in clean
    assert clean.index("94.06") < clean.index("96.71") < clean.index("**98.00** (1)")
    assert page.index("| clean |") < page.index("| n_clean=1 uniform |")
    assert "*better*" in _line(page, "| n_clean=1 uniform |", "60.00")
    assert "**0.995**" in page
    assert "clean third" in page
    # +2.65 is what the source's own two cells differ by.
    paired = _line(page, "argate_l - baseline")
    assert "+6.90 [+0.50, +13.30] | < 0.0005 | 2 | +2.65 | holds" in paired
    assert "**0.875** (2)" in page
    assert (
        "Command: `python scripts/studies/reproduce.py --table 3.1`; preset paper; commit abc1234"
        in page
    )
    assert "## A study of steps" in page
    assert _line(page, "| S4 |").startswith("| S4 | **50.5** steps (3) | **70.00** % (3) |")

    readme = config.readme.read_text()
    assert readme.startswith("# top\n<!-- results:begin -->\nThe source prints 216 numbers. 3 of")
    assert readme.endswith("<!-- results:end -->\nbottom\n")
    assert "old" not in readme
    # Of the 55 cells of Tables 3.1 to 3.3; two seeds leave a wide interval.
    assert "| Fusion, HAR (3.1 to 3.3) | · | 2 | 1 | · | 52 |" in readme


def test_rendering_twice_changes_nothing(config: render_results.Config) -> None:
    config.readme.write_text("<!-- results:begin -->\n<!-- results:end -->\n")
    texts = []
    for _ in range(2):
        render_results.main(config)
        texts.append((config.readme.read_text(), (config.docs / "results.md").read_text()))
    assert texts[0] == texts[1]


def test_a_readme_without_markers_is_left_alone(
    config: render_results.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    config.readme.write_text("# top\n")
    assert render_results.main(config)["readme"] == "unchanged"
    assert config.readme.read_text() == "# top\n"
    assert "<!-- results:begin -->" in capsys.readouterr().err


def test_an_empty_folder_is_refused(config: render_results.Config, tmp_path: Path) -> None:
    empty = render_results.Config(results=tmp_path / "none", docs=config.docs, runs=config.runs)
    with pytest.raises(ValueError, match=r"holds no result of record; make one with"):
        render_results.main(empty)


def test_single_runs_give_figure_and_studies(config: render_results.Config) -> None:
    def keep(model: str, seed: int, failed: list[float], clean: list[float]) -> None:
        weights = {"name": "total_acc_y", "when_failed": failed, "when_clean": clean}
        folder = config.runs / "3.1" / "n_clean=1_uniform" / model
        write_json(folder / f"{seed}.json", {"channel": weights})

    keep("netgated", 0, [0.1, 0.3], [0.2])
    keep("argate_plus", 0, [0.05, 0.05], [0.5])
    keep("argate_plus", 1, [0.09, 0.09], [0.7])
    write_json(
        config.runs / "3.1" / "n_clean=5_uniform" / "argate_l" / "0.json",
        {"robustness": {"zero": 60.0, "drift": 90.0}, "accuracy_clean": 100.0},
    )
    made = render_results.main(config)
    assert made["figure"].stat().st_size > 5000
    page = (config.docs / "results.md").read_text()
    assert "(images/study_channel_weights.png)" in page
    assert "**0.070**" in _line(page, "| argate_plus |", "**0.600**")
    assert "**60.00** (1)" in _line(page, "tested on zero")
    assert "**0.750** (1)" in page
    # Unchanged numbers keep the date and commit with which they were first written.
    path = config.results / "study_unseen_kinds.json"
    held = json.loads(path.read_text())
    write_json(path, held | {"date": "2026-01-03"})
    render_results.main(config)
    assert json.loads(path.read_text())["date"] == "2026-01-03"


def test_units_stand_in_the_heading_or_in_the_cells() -> None:
    rows = [
        {"row": name, "model": "pBO", "metric": "worst_case", "unit": unit, "mean": 9.4}
        for name, unit in (("current", "mA"), ("undershoot", "V"))
    ]
    assert "**worst case [mA]**" in markdown.measured(rows[:1])
    mixed = markdown.measured(rows)
    assert "**worst case**\n" in mixed
    assert "| current | **9.4** mA |" in mixed
    assert "| undershoot | **9.4** V |" in mixed


def test_markers_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ValueError, match="in this order"):
        markdown.replace_block("<!-- a:end --><!-- a:begin -->", "a", "new")


def test_systems_of_chapter_5_have_a_chapter_of_their_own(config: render_results.Config) -> None:
    compared = {"row": "clean", "comparison": "spiking_argate - argate_l", "n": 5}
    compared |= {"difference": -1.25, "low": -2.0, "high": -0.5, "p_value": 0.01}
    path = config.results / "study_spiking_fusion.json"
    write_json(path, STUDY | {"title": "Spikes", "comparisons": [compared]})
    render_results.main(config)
    page = (config.docs / "results.md").read_text()
    chapter, spikes, other = (
        page.index(text) for text in (f"## {pages.CHAPTER_5}", "### Spikes", "## A study of steps")
    )
    assert chapter < spikes < other
    line = _line(page, "| clean | spiking_argate - argate_l |")
    assert "-1.25 [-2.00, -0.50] | 0.010 | 5 |" in line
