"""The told failures of a trained detector, calibrated on frames that its training did not see."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import expit

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.examples import Example
from fusion.detection.learning.fitting import failed_inputs
from fusion.detection.learning.training import SENSOR_FAILURES, DetectorState
from fusion.detection.network.dense import DenseDetector
from fusion.detection.network.detector import Detector
from fusion.detection.network.inputs import Inputs
from fusion.detection.sensors.platt import (
    Calibration,
    alarm_threshold,
    fit_platt,
    frames_needed,
)
from fusion.predictive_scores import outcome_brier, outcome_calibration_error

MOST_FRAMES = 512
LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Severities of the failures, those of the robustness suite."""


class CalibrationReport(NamedTuple):
    """Scores on the frames of the calibration, for (camera, lidar).

    Attributes:
        frames: how many frames, each read three times.
        brier_before, brier: Brier score as told and calibrated.
        error_before, error: expected calibration error, likewise.
    """

    frames: int
    brier_before: tuple[float, float]
    brier: tuple[float, float]
    error_before: tuple[float, float]
    error: tuple[float, float]


@functools.lru_cache(maxsize=8)
def _log_odds(config: DetectorConfig) -> Callable[..., Any]:
    # All but the told failures is dead code inside jit: no convolution runs.
    def run(main: Any, stats: Any, inputs: Inputs) -> jax.Array:
        if config.is_dense:
            dense: Any = DenseDetector(config)
            grids = dense.apply({"params": main}, inputs, method="encode")
            return grids.failed[0]
        two: Any = Detector(config)
        variables = {"params": main, "batch_stats": stats}
        encoded = two.apply(variables, inputs.image, inputs.bev, False, method="encode")
        return encoded.failed[0]

    return jax.jit(run)


def read_log_odds(
    config: DetectorConfig,
    state: DetectorState,
    n_frames: int,
    read: Callable[[int], Example],
    *,
    kinds: Sequence[str] = SENSOR_FAILURES,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """What the head tells of frames, each as it is, with its camera failed and with its lidar.

    Kinds and the five severities come in turns, so that each combination is equally frequent.

    Args:
        config, state: of a trained detector that tells failures.
        n_frames, read: number of frames and the example of frame i; at most `MOST_FRAMES` are read,
            at even distances.
        kinds: failures of both sensors, of `SENSOR_FAILURES`.
        seed: of their noise.

    Returns:
        Log odds `[n, 3, 2]` of (camera, lidar), frame by frame for (none, camera, lidar) failed,
        and which sensor fails `[n, 3, 2]`.

    Raises:
        ValueError: a detector that tells nothing, or no kind of one of the sensors.
    """
    if not (config.gated and config.gate_statistics):
        raise ValueError(
            f"model={config.model!r}: expected one that tells failures; take dense_argate or "
            "avod_argate with gate_statistics"
        )
    of = {s: [k for k in kinds if k.startswith(s)] for s in ("camera", "lidar")}
    unknown = [kind for kind in kinds if kind not in SENSOR_FAILURES]
    if unknown or not all(of.values()):
        raise ValueError(
            f"kinds={tuple(kinds)}: expected of {', '.join(SENSOR_FAILURES)}; give at least one of "
            "each sensor"
        )
    run, told = _log_odds(config), []
    chosen = min(MOST_FRAMES, n_frames)
    for position in range(chosen):
        example = read(position * n_frames // chosen)
        rows = []
        for failing in (None, *of.values()):
            failure = failing[position % len(failing)] if failing else None
            level = LEVELS[position // len(failing) % len(LEVELS)] if failing else 1.0
            inputs = failed_inputs(
                config, example, failure=failure, severity=level, seed=seed, position=position
            )
            rows.append(run(state.params["main"], state.stats, inputs))
        told.append(jax.device_get(rows))
    failed = np.array([[False, False], [True, False], [False, True]])
    return np.asarray(told, np.float64), np.broadcast_to(failed, (chosen, 3, 2))


def calibrate_log_odds(
    log_odds: np.ndarray, failed: np.ndarray, false_alarm_rate: float = 0.01
) -> tuple[Calibration, CalibrationReport]:
    """The calibration of log odds as `read_log_odds` gives them, and what it changed.

    Raises:
        ValueError: like `fit_platt` and `alarm_threshold`.
    """
    fits, scores = [], []
    for k in range(2):
        told, truth = log_odds[..., k], failed[..., k].ravel()
        slope, offset = fit_platt(told.ravel(), truth)
        before = expit(told)
        after = expit(slope * told + offset)
        fits.append((slope, offset, alarm_threshold(after[:, 0], false_alarm_rate)))
        scores.append(
            [
                f(p.ravel(), truth)
                for f in (outcome_brier, outcome_calibration_error)
                for p in (before, after)
            ]
        )
    made = Calibration(*(np.asarray(column, np.float32) for column in zip(*fits, strict=True)))
    of_sensors: list[Any] = list(zip(*scores, strict=True))
    return made, CalibrationReport(len(log_odds), *of_sensors)


def calibrate_told_failures(
    config: DetectorConfig,
    state: DetectorState,
    n_frames: int,
    read: Callable[[int], Example],
    *,
    kinds: Sequence[str] = SENSOR_FAILURES,
    false_alarm_rate: float = 0.01,
    seed: int = 0,
) -> tuple[Calibration, CalibrationReport]:
    """Calibrate the failures that a trained detector tells; nothing of the detector changes.

    A third of the readings is clean, in a third the camera fails, in a third the lidar. Where
    failures are rarer, as on the road, the odds are too high by the ratio; `threshold` does not
    depend on it.

    Args:
        config, state: of a trained detector.
        n_frames, read: frames that no training saw, as for `read_log_odds`.
        kinds: failures; those of the training, where it left kinds out.
        false_alarm_rate: of `alarm_threshold`.
        seed: of the failures' noise.

    Raises:
        ValueError: a detector that tells nothing, too few frames for the rate, unknown kinds.
    """
    if n_frames < frames_needed(false_alarm_rate):
        # Before any frame is read.
        alarm_threshold(np.zeros(n_frames), false_alarm_rate)
    told, failed = read_log_odds(config, state, n_frames, read, kinds=kinds, seed=seed)
    return calibrate_log_odds(told, failed, false_alarm_rate)
