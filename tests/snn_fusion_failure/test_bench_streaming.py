"""The slides that are timed: answers are compared, and a turn gives one value of each row."""

from __future__ import annotations

import numpy as np
import pytest

from snn_fusion_failure.runs import one_core
from tests._scripts import load_script

bench = load_script("benchmarks/bench_streaming")


def test_answers_that_differ_are_not_timed() -> None:
    whole = [(np.full((1, 2), 0.5), np.ones((1, 2)), np.zeros((1, 2)))] * 3
    found = {
        "sensor_stream": list(whole),
        "whole_window": whole,
        "uncompiled": [(*whole[0][:2], None)],
    }
    assert bench.check_equal(found) == {"sensor_stream": 0.0, "uncompiled": 0.0}
    for shift in (1e-7, np.nan):
        last = (whole[0][0] + shift, *whole[0][1:])
        with pytest.raises(ValueError, match="sensor_stream: expected the answers of whole_window"):
            bench.check_equal(found | {"sensor_stream": [*whole[:2], last]})


def test_a_row_holds_one_value_of_each_turn() -> None:
    times = {"sensor_stream": [[1.0, 2.0, 3.0], [3.0, 4.0, 50.0]], "whole_window": [[1.0], [2.0]]}
    rows = bench.rows_of(times)
    assert [row["metric"] for row in rows] == ["slide_median"] * 2 + ["slide_p95"] * 2
    assert rows[0]["values"] == [2.0, 4.0] and rows[0]["median"] == 3.0
    assert rows[2]["values"] == pytest.approx([2.9, 45.4])
    assert [row.get("target") for row in rows] == [2.0, None, 2.0, None]


def test_one_core_is_chosen_before_the_libraries_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, set[int]]] = []
    monkeypatch.setattr(one_core.os, "sched_getaffinity", lambda _: {3, 5}, raising=False)
    monkeypatch.setattr(
        one_core.os, "sched_setaffinity", lambda *given: asked.append(given), raising=False
    )
    monkeypatch.setattr(one_core.os, "environ", {"XLA_FLAGS": "--of_mine=1"})
    assert one_core.pin(None) == 3 and one_core.pin(5) == 5
    assert asked == [(0, {3}), (0, {5})]
    assert one_core.os.environ["XLA_FLAGS"].split().count("intra_op_parallelism_threads=1") == 1
    assert one_core.os.environ["XLA_FLAGS"].startswith("--of_mine=1 ")
