"""Named settings, and the strings with which the scripts change them."""

from __future__ import annotations

import pytest

from jaxsnn.config import check_network
from jaxsnn.presets import SETTINGS, network_setting
from snn_fusion_failure.commands.train_snn import metrics, parse_changes, success
from tests._scripts import load_script

STUDIES = load_script("studies/study_snn").STUDIES


@pytest.mark.parametrize("setting", sorted(SETTINGS))
@pytest.mark.parametrize("network", ["S1", "S2", "S3", "S4"])
def test_settings_are_acceptable(network, setting):
    config, params = network_setting(network, setting)
    check_network(config, params)
    assert params.reward.k == (0.3 if config.rule == "additive" else 1.3)


def test_literal_is_the_source():
    config, params = network_setting("S4", "literal")
    assert params.stdp.anti_causal == 1.0 and params.homeostasis == 0.0
    assert params.reward.opponent == 0.0 and params.steering_gain == 1.0
    assert config.bounds == "hard" and params.w_max == 5.0 and params.w_max_low == 2.5


def test_changes_reach_their_part():
    changes = parse_changes(("params.gamma=5e-4", "config.bounds=soft", "stdp.tau_z=0.05"))
    config, params = network_setting("S4", "tuned", **changes)
    assert params.gamma == 5e-4 and config.bounds == "soft" and params.stdp.tau_z == 0.05


@pytest.mark.parametrize("text", ["gamma=1", "params.gamma", "world.speed=1"])
def test_bad_changes_are_named(text):
    with pytest.raises(ValueError, match="with part config"):
        parse_changes((text,))


def test_unknown_setting_is_named():
    with pytest.raises(ValueError, match="setting = 'best'"):
        network_setting("S4", "best")


def test_every_variant_of_every_study_builds():
    for variants in STUDIES.values():
        for setting, changes in variants.values():
            check_network(*network_setting("S4", setting, **parse_changes(changes)))


def test_metrics_count_arrivals_only():
    def record(status, steps):
        phase = {"status": status, "steps": steps, "path": [15.0 * s for s in steps]}
        return {"learning": phase, "testing": phase}

    records = [record([0, 1, 2, 0], [30, 5, 200, 50]), record([1, 1, 1, 1], [9, 9, 9, 9])]
    assert success(records[0], "testing") == 50.0
    summary = metrics(records)
    assert summary["sr_testing"]["mean"] == 25.0
    assert summary["n_mv"]["values"] == [40.0] and summary["path"]["mean"] == 600.0
