"""Paired comparisons of the networks' tables: which pairs, which sign, which seeds."""

from __future__ import annotations

import numpy as np
from scipy import stats

from tests._scripts import load_script

compare = load_script("studies/compare_snn").compare


def test_differences_are_paired_by_seed_and_missing_networks_are_left_out():
    rng = np.random.default_rng(0)
    base = rng.uniform(60, 90, 12)
    values = {"S3": base.tolist(), "S4": [*(base + rng.uniform(1, 6, 12)).tolist(), 0.0]}
    rows = [
        {"row": "Scenario 1", "model": m, "metric": "sr_testing", "values": v}
        for m, v in values.items()
    ]
    rows.append({"row": "Scenario 1", "model": "S1", "metric": "n_mv", "values": [1.0]})
    (found,) = compare({"rows": rows}, "sr_testing")
    want = stats.ttest_rel(values["S4"][:12], values["S3"])
    assert found["comparison"] == "S4 - S3" and found["n"] == 12
    np.testing.assert_allclose([found["t"], found["p_value"]], [want.statistic, want.pvalue])
