"""A fitted network in use: absent and dead sensors, raw units, one file, clear refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.data import from_arrays, validation_split
from fusion.data.dataset import Dataset
from fusion.encoders import EncoderConfig, reading_levels
from fusion.failures import random_failing
from fusion.fitted import FittedARGate, finish
from fusion.loop import Corruption, fit
from fusion.models import export, init, predict

# optax's Adam raises a float to an integer power, which strict promotion forbids.
pytestmark = pytest.mark.relaxed

CHANNELS = ("volts", "bar", "kelvin")


def _data() -> Dataset:
    """Three sensors in their own units, each of which tells the class."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, 1600)
    level = np.where(y == 1, 1.0, -1.0)[:, None] + 0.3 * rng.normal(size=(1600, 3))
    x = np.array([5.0, 1e5, 300.0]) + np.array([1.0, 2e4, 10.0]) * level
    return from_arrays(x[:, :, None], y, channels=CHANNELS, classes=("low", "high"))


DATA = _data()
MODEL = ModelConfig(
    "argate_plus",
    n_sensors=3,
    n_times=1,
    n_classes=2,
    encoder=EncoderConfig(features=8, frequencies=3, levels=reading_levels(DATA.train_x, 16)),
    gate_width=8,
    head_widths=(8,),
    dropout=0.0,
)
PROTOCOL = random_failing(CHANNELS, n_clean=2)
NOISE = Corruption(PROTOCOL, PROTOCOL)
RAW = np.array([5.0, 1e5, 300.0]) + np.array([1.0, 2e4, 10.0]) * np.array([[1.0], [-1.0], [0.5]])
RAW = RAW[:, :, None]  # three windows: high, low, high


@pytest.fixture(scope="module")
def fitted() -> FittedARGate:
    key = jax.random.key(0)
    held_out = validation_split(DATA)
    train = TrainConfig(epochs=6, batch_size=64)
    state = fit(MODEL, train, HyperParams(1e-2), held_out, NOISE, key=key).state
    return finish(MODEL, state, held_out, NOISE, key=key, false_alarm_rate=0.02)


@pytest.mark.parametrize("model", MODELS)
def test_an_absent_sensor_is_never_read(model: str) -> None:
    config = ModelConfig(
        model,
        n_sensors=3,
        n_times=1,
        n_classes=2,
        encoder=EncoderConfig(features=4, frequencies=2),
        gate_width=4,
        head_widths=(4,),
        embrace_width=4,
    )
    main = export(init(jax.random.key(1), config))
    x = jax.random.uniform(jax.random.key(2), (4, 3, 1), minval=-1.0)
    healthy = jnp.zeros((4, 3), bool)
    there = ~healthy.at[0, 1].set(True).at[1, :].set(True)

    told = healthy if config.reads_failed else None

    @jax.jit
    def run(x: jax.Array, there: jax.Array) -> Any:
        return predict(config, main, x, told, available=there)

    all_there = run(x, ~healthy)
    out = run(x, there)
    np.testing.assert_array_equal(out.logits[2:], all_there.logits[2:])
    for reading in (0.9, jnp.nan, jnp.inf):
        other = run(x.at[0, 1].set(reading), there)
        np.testing.assert_array_equal(other.logits, out.logits)
    # NaN alone says the same.
    gone = jnp.where(there[:, :, None], x, jnp.nan)
    np.testing.assert_array_equal(run(gone, ~healthy).logits, out.logits)
    assert np.isfinite(out.logits).all()
    np.testing.assert_allclose(out.weights.sum(1), [1.0, 0.0, 1.0, 1.0], atol=1e-6)
    assert out.weights[0, 1] == 0.0
    slope = jax.grad(lambda x: jnp.sum(run(x, there).logits[0] ** 2))(x)
    assert not slope[0, 1].any() and slope[0, 0].any()


@pytest.mark.slow
def test_raw_windows_give_probabilities_and_weights(fitted: FittedARGate) -> None:
    found = fitted.predict(RAW, channels=CHANNELS)
    assert found.probabilities.argmax(1).tolist() == [1, 0, 1]
    np.testing.assert_allclose(found.probabilities.sum(1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(found.weights.sum(1), 1.0, rtol=1e-5)
    assert not found.out_of_range.any()
    far = RAW.copy()
    far[0, 1] = 1e6
    assert fitted.predict(far).out_of_range.tolist() == [[False, True, False]] + [[False] * 3] * 2


def test_missing_readings_are_absent_sensors(fitted: FittedARGate) -> None:
    gone = RAW.copy()
    gone[:, 2] = np.nan
    found = fitted.predict(gone)
    assert found.probabilities.argmax(1).tolist() == [1, 0, 1]
    assert (found.weights[:, 2] == 0.0).all() and found.failed[:, 2].all()
    there = np.ones((3, 3), bool)
    there[:, 2] = False
    same = fitted.predict(RAW, available=there)
    np.testing.assert_array_equal(same.probabilities, found.probabilities)


def test_dead_sensors_are_told_at_the_stated_false_alarm_rate(fitted: FittedARGate) -> None:
    scale = DATA.scale
    span = (scale.high - scale.low)[None, :, None]
    raw = scale.low[None, :, None] + 0.5 * (DATA.test_x + 1.0) * span
    alarms = fitted.predict(raw).failed.mean(0)
    assert (alarms < 0.06).all()  # 0.02 on the rows of calibration, about 300
    broken = raw.copy()
    broken[:, 0] = 0.5 * (scale.low[0] + scale.high[0])  # stays at the middle of its range
    found = fitted.predict(broken)
    assert found.failed[:, 0].mean() > 0.9 and found.failed[:, 1:].mean() < 0.06
    assert found.failure_probability[:, 0].mean() > found.failure_probability[:, 1].mean()


def test_a_saved_network_is_the_same_network(fitted: FittedARGate, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "net.npz"
    fitted.save(path)
    assert [p.name for p in path.parent.iterdir()] == ["net.npz"]
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
    again = FittedARGate.load(path)
    assert again.config == fitted.config and again.classes == ("low", "high")
    for a, b in zip(again.predict(RAW), fitted.predict(RAW), strict=True):
        np.testing.assert_array_equal(a, b)
    np.savez(tmp_path / "other.npz", a=np.ones(2))
    whole = path.read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("no arrays")
    np.save(tmp_path / "array.npy", RAW)
    for name in ("other.npz", "half.npz", "text.npz", "array.npy", "deep"):
        with pytest.raises(ValueError, match=rf"{name}'.*a whole file of FittedARGate\.save"):
            FittedARGate.load(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"none.npz'.*there is none, check it"):
        FittedARGate.load(tmp_path / "none.npz")
    with pytest.raises(ValueError, match="expected a file, not a folder"):
        fitted.save(tmp_path)


def test_what_is_not_a_batch_of_windows_is_refused(fitted: FittedARGate) -> None:
    infinite = RAW.copy()
    infinite[1, 2] = np.inf
    for x, options, kind, message in (
        (RAW[0], {}, ValueError, r"x.shape=\(3, 1\): expected \[batch, 3 sensors.*x\[None\]"),
        (RAW.transpose(0, 2, 1), {}, ValueError, r"sensors come before samples"),
        (RAW[:, :2], {}, ValueError, r"made for other sensors"),
        (RAW.astype(str), {}, TypeError, r"x.dtype=<U.*: expected numbers"),
        (infinite, {}, ValueError, r"x\[1, 2\]=window with infinity.*'kelvin'"),
        (RAW, {"channels": ("bar", "volts", "kelvin")}, ValueError, r"put the sensors in this"),
        (RAW, {"available": np.ones(3, bool)}, ValueError, r"available.shape=\(3,\)"),
        (RAW, {"available": [["yes", "no", "no"]] * 3}, TypeError, r"available.dtype=<U3"),
        (RAW, {"available": np.full((3, 3), np.nan)}, TypeError, r"True and False"),
        (RAW[:0], {}, ValueError, r"expected one window or more"),
        ([[[5.0], [1e5, 1e5], [300.0]]], {}, ValueError, r"sequences of unequal length"),
    ):
        with pytest.raises(kind, match=message):
            fitted.predict(x, **options)
