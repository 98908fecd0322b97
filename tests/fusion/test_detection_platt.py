"""Told failures that can be taken at their word: fit, threshold, scores; the detector stays."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.learning.examples import Example
from fusion.detection.learning.failure_calibration import (
    calibrate_log_odds,
    calibrate_told_failures,
    read_log_odds,
)
from fusion.detection.learning.training import DetectorState
from fusion.detection.presets import preset
from fusion.detection.sensors.platt import alarm_threshold, fit_platt, frames_needed, rescaled
from fusion.evaluate import auroc
from fusion.predictive_scores import outcome_brier, outcome_calibration_error

STATE = DetectorState(None, None, None, jnp.zeros((), jnp.int32))  # not looked at before the checks


def drawn(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Honest log odds `[n, 3, 2]` of readings (clean, camera fails, lidar fails), and the truth."""
    rng = np.random.default_rng(seed)
    failed = np.array([[False, False], [True, False], [False, True]])
    failed = np.broadcast_to(failed, (n, 3, 2))
    # Two normal densities a unit apart in the middle: their log odds are linear.
    return rng.normal(np.where(failed, 1.0, -1.0), 1.0) * 2.0 - np.log(2.0), failed


def test_wrong_scale_and_offset_are_found_again() -> None:
    honest, failed = drawn(4000, 0)
    told = 3.0 * honest + 5.0
    made, report = calibrate_log_odds(told, failed)
    np.testing.assert_allclose(made.slope, 1 / 3, rtol=0.05)
    np.testing.assert_allclose(made.offset, -5 / 3, rtol=0.05)
    again, truth = drawn(4000, 1)
    for k in range(2):
        assert report.brier[k] < 0.8 * report.brier_before[k]
        assert report.error[k] < 0.02 < 0.1 < report.error_before[k]
        # On frames that took no part.
        z = np.asarray(rescaled(made, jnp.asarray(3.0 * again + 5.0, jnp.float32)))[..., k].ravel()
        p, y = 1 / (1 + np.exp(-z)), truth[..., k].ravel()
        assert outcome_calibration_error(p, y) < 0.02
        raw = again[..., k].ravel()
        assert auroc(z[y], z[~y]) == pytest.approx(auroc(raw[y], raw[~y]), abs=1e-6)
        alarms = (p.reshape(-1, 3)[:, 0] > made.threshold[k]).mean()
        assert 0.003 < alarms < 0.02


def test_separated_and_useless_log_odds_give_finite_honest_numbers() -> None:
    y = np.arange(40) >= 20
    slope, offset = fit_platt(np.where(y, 9.0, -9.0), y)
    p = 1 / (1 + np.exp(-(slope * np.array([-9.0, 9.0]) + offset)))
    np.testing.assert_allclose(p, [1 / 22, 21 / 22], rtol=1e-6)  # Platt's targets
    slope, offset = fit_platt(np.where(y, -1.0, 1.0) + np.linspace(0, 0.1, 40), y)
    assert slope == 0.0 and offset == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(ValueError, match="log_odds of 0 failed and 3 working readings: expected"):
        fit_platt(np.zeros(3), np.zeros(3, bool))
    with pytest.raises(ValueError, match="expected finite ones"):
        fit_platt(np.array([np.nan, 0.0]), np.array([True, False]))


@pytest.mark.parametrize(("n", "rate"), [(99, 0.01), (100, 0.03), (9, 0.1)])
def test_the_rate_of_false_alarms_holds_over_calibrations(n: int, rate: float) -> None:
    rng = np.random.default_rng(n)
    above = [
        (rng.uniform(size=200) > alarm_threshold(rng.uniform(size=n), rate)).mean()
        for _ in range(1000)
    ]
    assert 0.5 * rate < np.mean(above) < 1.15 * rate
    least = frames_needed(rate)
    with pytest.raises(ValueError, match=f"rate={rate}: expected at least {least} frames"):
        alarm_threshold(np.zeros(least - 1), rate)
    with pytest.raises(ValueError, match=r"false_alarm_rate=1\.0: expected a share"):
        alarm_threshold(np.zeros(9), 1.0)


def test_scores_of_probabilities_by_hand() -> None:
    p, y = np.array([0.2, 0.2, 0.8, 1.0]), np.array([False, True, True, True])
    assert outcome_brier(p, y) == pytest.approx((0.04 + 0.64 + 0.04) / 4)
    assert outcome_brier(p, y, np.array([1.0, 0, 0, 1])) == pytest.approx(0.02)
    # Bins: {0.2, 0.2} 0.3 too low, {0.8} 0.2 too low, {1.0} right.
    assert outcome_calibration_error(p, y) == pytest.approx(0.5 * 0.3 + 0.25 * 0.2)
    assert outcome_calibration_error(p, y, np.array([0.0, 0, 1, 3])) == pytest.approx(0.05)
    with pytest.raises(ValueError, match="probabilities=array: expected numbers from 0 to 1"):
        outcome_brier(np.array([np.nan]), np.array([True]))


def test_what_cannot_be_calibrated_is_refused_before_a_frame_is_read() -> None:
    def never(i: int) -> Example:
        raise AssertionError("a frame was read")

    config = preset("tiny", "dense_argate").config
    with pytest.raises(ValueError, match=r"rate=0\.01: expected at least 99 frames .* not 5"):
        calibrate_told_failures(config, STATE, 5, never)
    with pytest.raises(ValueError, match="model='dense': expected one that tells failures"):
        read_log_odds(preset("tiny", "dense").config, STATE, 5, never)
    for kinds in (("camera_fog",), ("camera_fog", "lidar_rain")):
        with pytest.raises(ValueError, match=r"kinds=\('camera_fog'.*give at least one of each"):
            read_log_odds(config, STATE, 5, never, kinds=kinds)
