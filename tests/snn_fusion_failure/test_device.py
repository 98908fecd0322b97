"""The prepared run for an accelerator works on a CPU, and a missing thing is a line."""

from __future__ import annotations

import json
import sys

import pytest

from tests._scripts import load_script

device = load_script("benchmarks/device")


def test_a_part_writes_its_file_at_once_and_a_crash_is_a_line(tmp_path, monkeypatch) -> None:
    config = device.Config(out=tmp_path, tiny=True, parts=("robots", "sweep"), minutes=5.0)
    found = device.main(config)
    rows = found["robots"]["rows"]
    assert [row["robots"] for row in rows] == [8, 16]
    copied = found["robots"]["bytes_per_s"]
    for row in rows:
        # The network's own: 7 groups of 8 inputs onto 24 hidden neurons, 12 of them per motor.
        assert row["synapses"] == 56 * 24 + 2 * 12
        wanted = row["robot_ms_per_s"] * 20.0 * row["synapses"] / 20 / copied
        assert row["share_of_bandwidth"] == pytest.approx(wanted) and wanted > 0
    assert found["sweep"]["complete"] and found["sweep"]["trials"] == 8
    held = json.loads((tmp_path / "robots.json").read_text())
    assert {"device", "git", "versions"} <= set(held)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    broken = device.run_part("sweep", config, 10.0)
    assert broken == {"part": "sweep", "missing": "ended with 1"}


def test_what_has_no_time_left_says_so(tmp_path) -> None:
    found = device.main(device.Config(out=tmp_path, minutes=0.0))
    assert set(found) == set(device.PARTS)
    assert {f["missing"] for f in found.values()} == {"no time was left"}
    with pytest.raises(ValueError, match="parts=warp: expected some of parity"):
        device.main(device.Config(out=tmp_path, parts=("warp",)))
