"""The study of fixed probabilities: one cell, resumed without a further run."""

from tests._scripts import load_script


def test_a_cell_is_measured_once_and_recorded(tmp_path):
    study = load_script("studies/study_sigma")
    config = study.Config(
        problems=("linear",), probabilities=(1e-6,), methods=("lines", "lines+gradient"), seeds=2,
        dim=12, out=tmp_path / "cells", record=tmp_path / "table.json",
    )  # fmt: skip
    rows = study.main(config)["rows"]
    by = {(r["model"], r["metric"]): r["mean"] for r in rows}
    assert by["lines+gradient", "success_rate"] == by["lines", "coverage"] == 1.0
    assert by["lines+gradient", "sims_factor2"] <= 20 < by["lines", "sims_factor2"] <= 60
    assert by["lines+gradient", "design_point_cosine"] > 0.999
    assert (tmp_path / "table.json").exists()
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "cells").rglob("*.json")}
    assert study.main(config)["rows"][0]["mean"] == rows[0]["mean"]
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps
