"""Wrong values are refused when they are given: name, value, what was expected, what to do."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fusion
from fusion import failures, gating, models
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data.dataset import check_dataset
from fusion.loop import Corruption, FitResult
from fusion.losses import LossConfig, LossParams
from fusion.streaming import SensorStream
from fusion.targets import TargetConfig

CHANNELS = ("a", "b", "c")
CLEAN = failures.no_failure(CHANNELS)
X = jnp.zeros((4, 3, 2))
DATA = fusion.load("simulated")
KEY = jax.random.key(0)
SMALL = ModelConfig(n_sensors=3, n_times=2)
FITTING: dict[str, Any] = {
    "model": ModelConfig(n_sensors=6, n_times=32, n_classes=4),
    "train": TrainConfig(),
    "hyper": HyperParams(),
    "data": DATA,
    "noise": Corruption(*[failures.no_failure(DATA.channels)] * 2),
    "key": KEY,
}


def fit(**changes: Any) -> Any:
    return fusion.fit(**(FITTING | changes))


WRONG: dict[str, Callable[[], Any]] = {
    "model='argate': expected one of": lambda: ModelConfig("argate"),
    "scale='median': expected one of 'mean', 'max'": lambda: ModelConfig(scale="median"),
    "normalizer='sparsemax': expected one of": lambda: ModelConfig(normalizer="sparsemax"),
    "fusion='product': expected one of": lambda: ModelConfig(fusion="product"),
    "dropout=1.0: expected a number in [0, 1)": lambda: ModelConfig(dropout=1.0),
    "head_widths[0]=0: expected a whole": lambda: ModelConfig(head_widths=(0,)),
    "aux_width=-1": lambda: ModelConfig(aux_width=-1),
    "embrace_width=0": lambda: ModelConfig(embrace_width=0),
    "n_classes=1: expected a whole number of at least 2": lambda: ModelConfig(n_classes=1),
    "weight_sharing='no'": lambda: ModelConfig(weight_sharing="no"),
    "encoder.levels=1 rows: expected one for each of 9": lambda: ModelConfig(
        encoder=fusion.EncoderConfig(levels=((0.0, 1.0),))
    ),
    "levels[0]=(1.0, 0.0): expected sorted": lambda: fusion.EncoderConfig(levels=((1.0, 0.0),)),
    "conv_kernels=(8,): expected 2 whole": lambda: fusion.EncoderConfig(conv_kernels=(8,)),
    "conv_strides[1]=0": lambda: fusion.EncoderConfig(conv_strides=(4, 0)),
    "backend='cuda': expected one of": lambda: fusion.EncoderConfig(backend="cuda"),
    "uniform_floor=7: expected a number in [0, 1]": lambda: LossConfig(uniform_floor=7),
    "label_smoothing=-0.1": lambda: LossConfig(label_smoothing=-0.1),
    "fixed_targets='sigmoid': expected one of": lambda: LossConfig(fixed_targets="sigmoid"),
    "stop_targets='yes'": lambda: LossConfig(stop_targets="yes"),
    "alpha=-1": lambda: LossParams(alpha=-1),
    "beta=-1: expected a number >= 0": lambda: LossParams(beta=-1),
    "tau=0: expected a number > 0": lambda: LossParams(tau=0),
    "anchor=nan": lambda: LossParams(anchor=float("nan")),
    "beta=-2.0": lambda: LossParams()._replace(beta=-2.0),
    "learning_rate=-1: expected a number >= 0": lambda: HyperParams(learning_rate=-1),
    "weight_decay=-0.1": lambda: HyperParams(weight_decay=-0.1),
    "epochs=0: expected a whole number": lambda: TrainConfig(epochs=0),
    "batch_size=-4": lambda: TrainConfig(batch_size=-4),
    "schedule='linear': expected one of": lambda: TrainConfig(schedule="linear"),
    "clip_norm=0": lambda: TrainConfig(clip_norm=0),
    "jitter=-1.0": lambda: TrainConfig(jitter=-1.0),
    "n_keypoints=1": lambda: TargetConfig(n_keypoints=1),
    "loss_range=(2.0, 0.0): expected": lambda: TargetConfig(loss_range=(2.0, 0.0)),
    "kind='unifrom': expected one of": lambda: Corruption(CLEAN, CLEAN, kind="unifrom"),
    "did you mean 'uniform'?": lambda: Corruption(CLEAN, CLEAN, kind="unifrom"),
    "test_kind='fog': expected one of": lambda: Corruption(CLEAN, CLEAN, test_kind="fog"),
    "test.n_channels=2: expected 3": lambda: Corruption(CLEAN, failures.no_failure("ab")),
    "channels=['a', 'a']: expected one or more different": lambda: failures.no_failure("aa"),
    "severity=1.5: expected a number in [0, 1]": lambda: failures.corrupt(
        CLEAN, X, key=KEY, severity=1.5
    ),
    "key=array of shape (2,), dtype uint32: expected a typed PRNG key": lambda: failures.corrupt(
        CLEAN, X, key=jax.random.PRNGKey(0)
    ),
    "key=0: expected a typed": lambda: failures.draw_mask(CLEAN, 4, key=0),
    "rate=2.0": lambda: gating.drop_modalities(jnp.zeros((3, 2, 4)), 2.0, key=KEY),
    "jax.random.key(seed)": lambda: models.init(jax.random.PRNGKey(0), ModelConfig()),
    "preset='best': expected one of 'quick', 'paper'": lambda: fusion.preset(
        fusion.load("simulated"), name="best"
    ),
    "split='subjcts': expected one of 'subject'; did you mean": lambda: fusion.load(
        "simulated", split="subjcts"
    ),
    "name='simulatd': expected one of": lambda: fusion.load("simulatd"),
    "key=array of shape (2,), dtype uint32: expected a typed PRNG key; make": lambda: fusion.fit(
        ModelConfig(n_sensors=6, n_times=32, n_classes=4),
        TrainConfig(),
        HyperParams(),
        DATA,
        Corruption(*[failures.no_failure(DATA.channels)] * 2),
        key=jax.random.PRNGKey(0),
    ),
    "kind='fog'": lambda: fusion.make_train(ModelConfig(), TrainConfig(), 64, CLEAN, "fog"),
    "protocol.n_channels=3: expected 9": lambda: fusion.make_train(
        ModelConfig(), TrainConfig(), 64, CLEAN
    ),
    "resume=True: expected checkpoint_dir": lambda: fit(resume=True),
    "main=parameters with auxiliary paths: expected": lambda: models.predict(
        SMALL, {"main": {}, "aux": {}}, X
    ),
}


WRONG_TYPES: dict[str, Callable[[], Any]] = {
    "n_clean=1.5: expected a whole number 0..2": lambda: failures.random_failing(CHANNELS, 1.5),
    "epochs=2.0": lambda: TrainConfig(epochs=2.0),
    "head_widths=[64]: expected a tuple": lambda: ModelConfig(head_widths=[64]),
    "tau='1'": lambda: LossParams(tau="1"),
    "train=str object: expected Protocol": lambda: Corruption("random", CLEAN),
    "train_y=list: expected a numpy array of class numbers": lambda: check_dataset(
        dataclasses.replace(DATA, train_y=[0, 1])
    ),
    "encoder=NoneType object: expected EncoderConfig": lambda: ModelConfig(encoder=None),
    "model=str object: expected ModelConfig": lambda: fit(model="argate_l"),
    "data=NoneType object: expected Dataset": lambda: fit(data=None),
    "noise=NoneType object: expected Corruption": lambda: fit(noise=None),
    "hyper=float object: expected HyperParams": lambda: fit(hyper=1e-3),
    "state=FitResult object: expected TrainState; give": lambda: fusion.test_output(
        FITTING["model"], FitResult(None, []), DATA, FITTING["noise"], key=KEY
    ),
    "x=list object: expected an array of numbers": lambda: models.predict(SMALL, {}, X.tolist()),
    "x.dtype=<U1: expected numbers": lambda: models.predict(SMALL, {}, np.full(X.shape, "a")),
    "available=list object: expected an array": lambda: models.predict(
        SMALL, {}, X, available=[[True] * 3] * 4
    ),
    "available.dtype=float32: expected True and False": lambda: models.predict(
        SMALL, {}, X, available=jnp.ones((4, 3))
    ),
    "fitted=str object: expected FittedARGate": lambda: SensorStream("net.npz"),
}


def refusals() -> dict[str, list[str]]:
    """What each wrong value is answered with: kind of the error and its text."""
    found = {}
    for message, make in {**WRONG, **WRONG_TYPES}.items():
        try:
            make()
            found[message] = ["nothing", ""]
        except Exception as error:
            found[message] = [type(error).__name__, str(error)]
    return found


@pytest.fixture(scope="module")
def answers() -> dict[str, list[str]]:
    """Asked in a process of its own: under pytest, wrong types meet the type checker first."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__))],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("message", [*WRONG, *WRONG_TYPES])
def test_a_wrong_value_is_refused_when_it_is_given(
    message: str, answers: dict[str, list[str]]
) -> None:
    kind, text = answers[message]
    assert kind == ("ValueError" if message in WRONG else "TypeError"), text
    assert message in text
    # name=value: expected ...; fix
    assert re.fullmatch(r"[\w.\[\]]+=.*: expected .*; .+", text, re.DOTALL), text


def test_params_stay_trees_of_whatever_a_program_puts_in() -> None:
    hyper = HyperParams(1e-2, loss=LossParams(tau=0.5))
    shapes = jax.eval_shape(lambda h: h, jax.tree.map(jnp.asarray, hyper))
    assert isinstance(shapes.loss, LossParams)
    slopes = jax.grad(lambda h: -h.learning_rate * h.loss.tau)(hyper)
    assert float(slopes.learning_rate) == -0.5 and isinstance(slopes, HyperParams)
    stacked = jax.tree.map(lambda v: jnp.full(2, v), hyper)
    mapped = jax.vmap(lambda h: h.loss.tau, in_axes=(HyperParams(0, 0, 0),))
    assert mapped(stacked).shape == (2,)


if __name__ == "__main__":
    print(json.dumps(refusals()))
