"""What the study of told failures finds on statistics whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.detection.learning.training import SENSOR_FAILURES
from snn_fusion_failure.records.detector_folds import FOLDS
from tests._scripts import load_script

study = load_script("studies/study_quality")


def _read(n: int = 300) -> object:
    """Two statistics a sensor: one scatters widely, the other hardly, and failures move that."""
    rng = np.random.default_rng(0)

    def frames(moved: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        parts = [
            np.stack([rng.normal(size=n), 0.02 * rng.normal(size=n) + shift], axis=1)
            for shift in moved
        ]
        return tuple(p.astype(np.float32) for p in parts)

    def failing(kind: str, place: int) -> tuple[np.ndarray, np.ndarray]:
        away = 0.1 if place % 2 else -0.1
        return frames((away, 0.0) if kind.startswith("camera") else (0.0, away))

    train = {"clean": frames((0.0, 0.0))}
    test = {"clean": frames((0.0, 0.0))}
    for place, kind in enumerate(SENSOR_FAILURES):
        train[kind] = failing(kind, place)
        test |= {(kind, level): failing(kind, place) for level in study.LEVELS}
    return study.Read(train, test)


@pytest.mark.slow
@pytest.mark.relaxed
def test_deviations_tell_kinds_that_raw_statistics_do_not() -> None:
    config = study.Config(Path("unused"), steps=400, seeds=1)
    found = study.scores(config, _read())
    least = {
        model: min(v[0]["failed_auroc"] for (_, m), v in found.items() if m == model)
        for model in {m for _, m in found}
    }
    assert least["deviations"] > 0.95 and least["deviations_unseen"] > 0.9
    assert least["distance"] > 0.9 and least["raw_unseen"] < 0.8
    assert min(least["monotonic"], least["monotonic_unseen"]) > 0.9
    assert len(found) == 7 * len(SENSOR_FAILURES) * len(study.LEVELS)
    assert len(FOLDS) == 3
