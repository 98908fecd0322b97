"""Training: learns a problem with a known answer, resumes to the bit, vmaps, stops clearly."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data import Dataset
from fusion.data.dataset import Scale
from fusion.encoders import EncoderConfig
from fusion.evaluate import gate_auroc, split_accuracy
from fusion.failures import no_failure, random_failing
from fusion.loop import Corruption, TrainingDiverged, fit, test_output
from fusion.losses import LossConfig, LossParams
from fusion.models import export
from fusion.prediction import predict_batches
from fusion.presets import preset
from fusion.targets import check_targets
from fusion.train import make_epoch, make_train

# optax's Adam raises a float to an integer power, which strict promotion forbids.
pytestmark = pytest.mark.relaxed

CHANNELS = ("a", "b", "c", "d")
MODEL = ModelConfig(
    model="argate_l",
    n_sensors=4,
    n_times=1,
    n_classes=3,
    encoder=EncoderConfig(features=8, frequencies=3, levels=((-0.8, 0.0, 0.8),) * 4),
    gate_width=8,
    head_widths=(16,),
    dropout=0.1,
    loss=LossConfig(uniform_floor=1.0, label_smoothing=0.0),
)
TRAIN = TrainConfig(epochs=6, batch_size=64)
HYPER = HyperParams(1e-2, 1e-4, LossParams(1.0, 3.0, 0.5, 0.3))
ONE_CLEAN = random_failing(CHANNELS, 1)
NOISE = Corruption(ONE_CLEAN, ONE_CLEAN)


def _dataset(n: int = 2048) -> Dataset:
    """Four copies of the label: any healthy sensor tells the class, so the best accuracy is 1."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 3, 2 * n).astype(np.int32)
    x = np.repeat((0.8 * (y - 1.0))[:, None, None], 4, axis=1).astype(np.float32)
    group = np.zeros(n, np.int32)
    scale = Scale(-np.ones(4), np.ones(4))
    return Dataset(
        "copies", x[:n], y[:n], x[n:], y[n:], group, group, CHANNELS, ("p", "q", "r"), "x", scale
    )


DATA = _dataset()


def _same(a: object, b: object) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.fixture(scope="module")
def trained() -> object:
    return fit(MODEL, TRAIN, HYPER, DATA, NOISE, key=jax.random.key(0))


@pytest.mark.slow
def test_learns_to_find_the_one_healthy_sensor(trained: object) -> None:
    output = test_output(MODEL, trained.state, DATA, NOISE, key=jax.random.key(0))
    parts = split_accuracy(output.labels, output.logits.argmax(-1), output.failed)
    assert parts.clean > 0.97
    assert parts.corrupted > 0.9  # by chance alone one in three
    assert gate_auroc(output.weights, output.failed) > 0.95
    assert trained.history[-1]["total"] < trained.history[0]["total"]
    assert check_targets(MODEL.targets, trained.state.params["targets"]) == 0


def test_resume_gives_the_same_bits(trained: object, tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill(epoch: int, row: dict[str, float]) -> None:
        if epoch == 2:
            raise Killed

    arguments, key = (MODEL, TRAIN, HYPER, DATA, NOISE), jax.random.key(0)
    with pytest.raises(Killed):
        fit(*arguments, key=key, checkpoint_dir=tmp_path / "c", on_epoch=kill)
    with pytest.raises(ValueError, match="expected a folder without checkpoints"):
        fit(*arguments, key=key, checkpoint_dir=tmp_path / "c")
    resumed = fit(*arguments, key=key, checkpoint_dir=tmp_path / "c", resume=True)
    _same(resumed.state, trained.state)
    assert resumed.history == trained.history
    other = {"key": key, "checkpoint_dir": tmp_path / "c", "resume": True}
    longer = dataclasses.replace(TRAIN, epochs=9)
    with pytest.raises(ValueError, match=r"resume=True: expected .* \(train.epochs: 6 -> 9\)"):
        fit(MODEL, longer, HYPER, DATA, NOISE, **other)
    with pytest.raises(ValueError, match=r"hyper.loss.beta: 3.0 -> 2.0\)"):
        softer = HYPER._replace(loss=HYPER.loss._replace(beta=2.0))
        fit(MODEL, TRAIN, softer, DATA, NOISE, **other)
    with pytest.raises(ValueError, match=r"\(key: 'array"):
        fit(*arguments, **(other | {"key": jax.random.key(1)}))


def test_a_checkpoint_is_due_by_the_clock_too(tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill(epoch: int, row: dict[str, float]) -> None:
        # A kill of the process, which runs no `finally`: look at what is on the disk already.
        if epoch == 2:
            assert [p.name for p in (tmp_path / "c").iterdir()] == ["1"]
            raise Killed

    short = dataclasses.replace(TRAIN, epochs=3)
    with pytest.raises(Killed):
        fit(
            MODEL,
            short,
            HYPER,
            DATA,
            NOISE,
            key=jax.random.key(0),
            checkpoint_dir=tmp_path / "c",
            checkpoint_minutes=0.0,
            on_epoch=kill,
        )


def test_non_finite_loss_stops_and_keeps_the_last_good_state(tmp_path: Path) -> None:
    hyper = HYPER._replace(loss=HYPER.loss._replace(alpha=jnp.float32("nan")))
    rest = {"key": jax.random.key(0), "checkpoint_dir": tmp_path / "c"}
    with pytest.raises(TrainingDiverged, match=r"epoch 1 is nan.*Lower the learning rate"):
        fit(MODEL, TRAIN, hyper, DATA, NOISE, **rest)
    # No epoch was good, so no checkpoint stands in the way of a better run.
    fit(MODEL, TRAIN, HYPER, DATA, NOISE, **rest)


@pytest.mark.slow
def test_whole_run_vmaps_over_seeds_and_hyper_parameters(trained: object) -> None:
    train = make_train(MODEL, TRAIN, len(DATA.train_x), ONE_CLEAN, "uniform")
    x, y = jnp.asarray(DATA.train_x), jnp.asarray(DATA.train_y)
    hyper = jax.tree.map(lambda v: jnp.full(2, v, jnp.float32), HYPER)
    hyper = hyper._replace(learning_rate=jnp.asarray([1e-2, 1e-3], jnp.float32))
    keys = jax.vmap(jax.random.key)(jnp.asarray([0, 1]))
    run = jax.vmap(lambda hyper, key: train(hyper, x, y, key=key))
    _, metrics = jax.jit(run)(hyper, keys)
    assert metrics.accuracy.shape == (2, TRAIN.epochs)
    # The first trial is the run of `fit` with the same key and settings.
    expected = [row["total"] for row in trained.history]
    np.testing.assert_allclose(metrics.loss.total[0], expected, rtol=2e-3)
    assert metrics.loss.total[1, 0] > metrics.loss.total[0, 0]


def test_evaluation_does_not_depend_on_the_chunk(trained: object) -> None:
    main, x = export(trained.state.params), jnp.asarray(DATA.test_x[:70])
    whole = predict_batches(MODEL, main, x, batch_size=70)
    parts = predict_batches(MODEL, main, x, batch_size=32)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), whole, parts)


def test_models_of_a_seed_see_the_same_corruption(trained: object) -> None:
    key = jax.random.key(5)
    baseline = dataclasses.replace(MODEL, model="baseline", loss=None)
    other = fit(baseline, dataclasses.replace(TRAIN, epochs=1), HYPER, DATA, NOISE, key=key)
    a = test_output(MODEL, trained.state, DATA, NOISE, key=key)
    b = test_output(baseline, other.state, DATA, NOISE, key=key)
    np.testing.assert_array_equal(a.failed, b.failed)


def test_bad_sizes_are_refused_before_any_compile() -> None:
    with pytest.raises(ValueError, match="batch_size=64: expected at most 10"):
        make_epoch(MODEL, TRAIN, 10)
    with pytest.raises(ValueError, match="epochs=0"):
        TrainConfig(epochs=0)
    wrong, key = dataclasses.replace(MODEL, n_classes=5), jax.random.key(0)
    clean = Corruption(*[no_failure(CHANNELS)] * 2)
    with pytest.raises(ValueError, match=r"n_classes=5: expected 3.*build the ModelConfig"):
        fit(wrong, TRAIN, HYPER, DATA, clean, key=key)
    other = Corruption(*[no_failure("abcde")] * 2)
    with pytest.raises(ValueError, match=r"noise.train.n_channels=5: expected 4"):
        fit(MODEL, TRAIN, HYPER, DATA, other, key=key)
    with pytest.raises(ValueError, match=r"dataset.name='copies': expected one of har"):
        preset(DATA)
