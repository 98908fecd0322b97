"""Presets, and the strings with which the commands change them; scores of an experiment."""

from __future__ import annotations

import pytest

from jaxsnn.config import check_network
from jaxsnn.presets import READINGS, preset
from jaxsnn.scores import score, success
from snn_fusion_failure.runs.networks import changed_preset
from tests._scripts import load_script

STUDY = load_script("studies/study_snn")


@pytest.mark.parametrize("reading", sorted(READINGS))
@pytest.mark.parametrize("network", ["S1", "S2", "S3", "S4"])
def test_readings_are_acceptable(network, reading):
    config, params = preset(network, reading)
    check_network(config, params)
    assert params.reward.k == (0.3 if config.rule == "additive" else 1.3)


def test_literal_is_the_source():
    config, params = preset("S4", "literal")
    assert params.stdp.anti_causal == 1.0 and params.homeostasis == 0.0
    assert params.reward.opponent == 0.0 and params.steering_gain == 1.0
    assert config.bounds == "hard" and params.w_max == 5.0 and params.w_max_low == 2.5


def test_changes_reach_their_part():
    changes = ("params.gamma=5e-4", "config.bounds=soft", "stdp.tau_z=0.05")
    config, params = changed_preset("S4", "tuned", changes)
    assert params.gamma == 5e-4 and config.bounds == "soft" and params.stdp.tau_z == 0.05


@pytest.mark.parametrize("order", [1, -1])
def test_sizes_that_depend_on_one_another_change_together(order):
    changes = ("config.control_steps=40", "config.hold_steps=20")[::order]
    config, _ = changed_preset("S4", "tuned", changes)
    assert (config.control_steps, config.hold_steps) == (40, 20)
    with pytest.raises(ValueError, match="hold_steps=30: expected a divisor"):
        changed_preset("S4", "tuned", ("config.hold_steps=30",))


@pytest.mark.parametrize("text", ["gamma=1", "params.gamma", "world.speed=1"])
def test_bad_changes_are_named(text):
    with pytest.raises(ValueError, match=r"expected part\.name=value with part one of config"):
        changed_preset("S4", "tuned", (text,))


def test_unknown_reading_is_named():
    with pytest.raises(ValueError, match="reading='best'"):
        preset("S4", "best")


def test_every_variant_of_every_study_builds():
    for name in (*STUDY.STUDIES, *STUDY.CONSTANTS):
        for reading in ("tuned", "way"):
            config = STUDY.Study(study=name, reading=reading)
            for of, changes in STUDY.variants_of(config).values():
                check_network(*changed_preset("S4", of, changes))


def test_a_constant_is_changed_around_the_reading_that_is_asked_for():
    tuned, way = (
        STUDY.variants_of(STUDY.Study(study="tau_z", reading=reading))
        for reading in ("tuned", "way")
    )
    assert tuned["tuned, tau_z 0.1 s"] == ("tuned", ("stdp.tau_z=0.1",))
    assert way["way, tau_z 0.1 s"] == ("way", ("stdp.tau_z=0.1",))


def test_metrics_count_arrivals_only():
    def record(status, steps):
        phase = {"status": status, "steps": steps, "path": [15.0 * s for s in steps]}
        return {"learning": phase, "testing": phase}

    records = [record([0, 1, 2, 0], [30, 5, 200, 50]), record([1, 1, 1, 1], [9, 9, 9, 9])]
    assert success(records[0], "testing") == 50.0
    values = score(records, [[100.0] * 4] * 2)
    assert values["sr_testing"] == [50.0, 0.0]
    assert values["n_mv"] == [40.0] and values["path"] == [600.0]
    assert values["path_ratio"] == [6.0] and values["path_ratio_median"] == [6.0]
