"""The command of the spiking networks: what its rows of record are called."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from snn_fusion_failure.commands import train_snn
from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import repository, write_json


def test_each_reading_is_recorded_under_its_own_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_json(tmp_path / "source_tables.json", {"2.3": {"rows": {"S4": {"sr_testing": 100}}}})
    monkeypatch.setattr(repository, "RESULTS", tmp_path)
    for reading, mean in (("tuned", 90.0), ("literal", 30.0), ("way", 99.0)):
        config = train_snn.Config(reading=reading)
        train_snn.record(config, {"sr_testing": summarize([mean - 1.0, mean + 1.0])})
    rows = json.loads((tmp_path / "table_2_3.json").read_text())["rows"]
    assert {row["model"]: row["mean"] for row in rows} == {
        "S4": 90.0, "S4 literal": 30.0, "S4 way": 99.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    "changed", [{"preset": "quick"}, {"preset": "paper", "changes": ("params.gamma=1e-4",)}]
)
def test_another_network_or_a_short_run_is_no_row_of_record(changed: dict[str, Any]) -> None:
    config = train_snn.Config(record=True, **changed)
    with pytest.raises(ValueError, match=r"record=True, preset=.*known by its name alone"):
        train_snn.main(config)
