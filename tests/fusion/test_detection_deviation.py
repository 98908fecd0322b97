"""Readings unlike clean ones are told, whatever made them so; the gate knows the clean ones."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import mahalanobis

from fusion.detection.learning import with_clean_readings
from fusion.detection.learning.checkpoints import Checkpoints
from fusion.detection.learning.examples import make_example
from fusion.detection.learning.training import DetectorTrainConfig, init_training
from fusion.detection.presets import preset
from fusion.detection.sensors import Clean, deviations, fit_clean
from fusion.evaluate import auroc
from tests.fusion.test_detection_network import a_frame


def _sample(n: int, seed: int, apart: float = 0.05) -> np.ndarray:
    """Four statistics of different sizes of which two nearly agree."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 4)) * [1.0, 0.01, 5.0, 1.0]
    x[:, 3] = x[:, 0] + apart * x[:, 3]
    return (x + np.array([3.0, 0.5, -2.0, 1.0])).astype(np.float32)


def test_length_is_the_distance_of_mahalanobis() -> None:
    data = _sample(4000, 0, 0.5)
    clean = fit_clean(data)
    inverse = np.linalg.inv(np.cov(data.T.astype(np.float64)))
    for x in _sample(5, 1, 0.5):
        white = (x - clean.mean) @ clean.whiten
        expected = mahalanobis(x, data.mean(axis=0), inverse)
        assert np.linalg.norm(white) == pytest.approx(expected, rel=0.03)


def test_a_change_that_hides_in_the_scatter_of_others_is_told() -> None:
    """A shift of two agreeing statistics apart, small in each; raw values do not tell it."""
    clean = fit_clean(_sample(256, 0))
    works, fails = _sample(200, 1), _sample(200, 2) + np.array([0.3, 0, 0, -0.3], np.float32)
    size = [np.asarray(deviations(clean, jnp.asarray(x)).sum(axis=1)) for x in (fails, works)]
    raw = [np.abs(x - clean.mean)[:, 0] for x in (fails, works)]
    assert auroc(*size) > 0.95 and auroc(*raw) < 0.7


def test_few_frames_do_not_make_a_direction_infinitely_telling() -> None:
    clean = fit_clean(_sample(3, 0))
    assert np.isfinite(clean.whiten).all()
    assert float(deviations(clean, jnp.asarray(_sample(50, 1))).max()) <= 2.0


def test_bad_statistics_are_refused_and_pass_no_gradient() -> None:
    with pytest.raises(ValueError, match="at least two clean frames"):
        fit_clean(_sample(1, 0))
    with pytest.raises(ValueError, match="finite"):
        fit_clean(np.full((4, 2), np.nan))
    same = Clean(np.zeros(2, np.float32), np.eye(2, dtype=np.float32))
    x = jnp.array([[1.0, -20.0]])
    np.testing.assert_allclose(deviations(same, x), [[0.25, 2.0]])
    assert float(jnp.abs(jax.grad(lambda x: deviations(same, x).sum())(x)).max()) == 0.0


@pytest.mark.parametrize("model", ["avod_argate", "dense_argate", "dense_oracle"])
def test_a_training_begins_with_the_clean_readings(model: str) -> None:
    config = preset("tiny", model).config
    example, _ = make_example(config, a_frame())
    state = init_training(jax.random.key(0), config)
    train = DetectorTrainConfig(steps=1, failure_share=2 / 3)
    known = with_clean_readings(config, train, state, 2, lambda i: example, key=jax.random.key(1))
    before, after = (s.params["main"]["clean"] for s in (state, known))
    assert float(jnp.abs(before["camera_mean"]).max()) == 0.0
    assert float(jnp.abs(after["camera_mean"]).max()) > 0.1
    assert jax.tree.structure(state) == jax.tree.structure(known)
    shapes = [jax.tree.map(lambda a: (a.shape, a.dtype), s) for s in (state, known)]
    assert shapes[0] == shapes[1]


def test_a_checkpoint_of_another_version_is_named(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"gate": jnp.zeros(2)}, [])
    with pytest.raises(ValueError, match=r"step 1: its parameters are not those .* train it anew"):
        checkpoints.restore({"gate": jnp.zeros(2), "clean": jnp.zeros(3)})
    step, state, _ = checkpoints.restore({"gate": jnp.ones(2)})
    checkpoints.close()
    assert step == 1 and float(state["gate"].sum()) == 0.0
