"""Rows of the table of detours: maps of learning and test are apart, and what a robot scores."""

from __future__ import annotations

import numpy as np
import pytest

from jaxsnn import families, planner
from jaxsnn.status import Status
from jaxsnn.world import WorldParams
from snn_fusion_failure.records import detour_rows


def _same(one: WorldParams, other: WorldParams) -> bool:
    return bool(
        np.array_equal(one.segments, other.segments) and np.array_equal(one.circles, other.circles)
    )


@pytest.mark.parametrize("row", [detour_rows.FAMILY, "detour/train/1"])
@pytest.mark.parametrize("split", ["validation", "test"])
def test_a_family_is_tested_on_maps_that_nothing_was_learnt_on(row: str, split: str) -> None:
    taught, tested = detour_rows.train_map(row), detour_rows.tested_maps(row, 3, split)
    assert not any(_same(taught, one) for one in tested)
    expected = [families.family_map("detour", split, i) for i in range(3)]
    assert all(_same(a, b) for a, b in zip(tested, expected, strict=True))
    assert detour_rows.trials_per_map(row, 20) == 1


def test_a_scenario_is_tested_where_it_was_learnt() -> None:
    for row in ("Scenario 2", "D3"):
        (tested,) = detour_rows.tested_maps(row, 3, "test")
        assert _same(tested, detour_rows.train_map(row))
        assert detour_rows.trials_per_map(row, 20) == 20


def test_a_robot_scores_arrivals_and_paths_of_those_that_arrived() -> None:
    map = detour_rows.train_map("Scenario 1")
    starts = np.asarray(map.starts)[:1, :2]
    shortest = float(planner.path_field(map).lengths(starts.astype(np.float64))[0])
    status = np.array([[[Status.ARRIVED, Status.COLLIDED], [Status.COLLIDED, Status.COLLIDED]]])
    path = np.array([[[1.5 * shortest, 9.0], [9.0, 9.0]]])
    points = np.broadcast_to(starts[0], (1, 2, 2, 2))
    found = detour_rows.values_of([map], status, path, points)
    assert found["sr_testing"] == [50.0, 0.0]
    assert found["path_ratio"] == pytest.approx([1.5])
