"""Scenarios 1-3 keep what the text fixes, and stay as they were when they were tuned on."""

from __future__ import annotations

import hashlib

import jax
import numpy as np
import pytest

from jaxsnn import planner, scenarios


@pytest.mark.parametrize("number", [1, 2, 3])
def test_every_start_leads_to_the_target(number: int) -> None:
    params = scenarios.scenario(number)
    field = planner.path_field(params)
    for (x, y, r), p in zip(np.asarray(params.starts), np.asarray(params.start_probs), strict=True):
        if p > 0:
            phi = np.linspace(0, 2 * np.pi, 8)
            rim = np.stack([x + r * np.cos(phi), y + r * np.sin(phi)], axis=1)
            assert np.isfinite(field.lengths(rim)).all()
            for point in rim:
                planner.check_pose(params, point)


def test_targets_and_starts_are_where_the_text_puts_them() -> None:
    one, two, three = (scenarios.scenario(n) for n in (1, 2, 3))
    for params in (one, two, three):
        np.testing.assert_array_equal(params.bounds, [0, 0, 800, 600])
    np.testing.assert_array_equal(one.target, [400, 300])  # the centre
    for params in (one, two):  # one circle at the left, one at the right, drawn equally often
        assert params.starts[0, 0] < 200
        assert params.starts[1, 0] > 600
        np.testing.assert_allclose(params.start_probs, 0.5)
    # One circle in the bottom-right corner.
    np.testing.assert_allclose(three.start_probs, [1.0, 0.0])
    assert three.starts[0, 0] > 600
    assert three.starts[0, 1] < 150


def test_obstacles_grow_in_number_and_shape() -> None:
    counts = []
    for number in (1, 2, 3):
        obstacles = planner.Obstacles.of(scenarios.scenario(number))
        counts.append(len(obstacles.loops()) + len(obstacles.circles))
    assert counts == sorted(set(counts))
    two = planner.Obstacles.of(scenarios.scenario(2))
    assert len({len(loop) for loop in two.loops()}) >= 4  # varying shapes


def test_maps_of_record_have_not_changed() -> None:
    """Results of record name these maps: a change of a map must be a new scenario."""
    digests = []
    for number in (1, 2, 3):
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(scenarios.scenario(number)):
            # Tenths of a pixel: the last bits of a sine may differ between machines.
            digest.update(np.round(10 * np.asarray(leaf, np.float64)).astype(np.int64).tobytes())
        digests.append(digest.hexdigest()[:12])
    assert digests == ["db2974218084", "eacd3d533bf1", "b7f9aa5d507c"]


def test_unknown_scenario_is_refused() -> None:
    with pytest.raises(ValueError, match=r"number=4: expected one of \[1, 2, 3\]"):
        scenarios.scenario(4)
