"""A fitted network at work: a sliding window, and a program for processes without this package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from fusion import Corruption, FittedARGate, finish, fit, load, preset, random_failing
from fusion.data import validation_split
from fusion.portable import write_onnx, write_program
from fusion.streaming import SensorStream


@pytest.fixture(scope="module")
def fitted() -> FittedARGate:
    data = validation_split(load("simulated"))
    settings = preset(data, "argate_plus", "quick")
    settings = settings._replace(train=settings.train.__class__(epochs=1, batch_size=64))
    protocol = random_failing(data.channels, 3)
    noise, key = Corruption(protocol, protocol), jax.random.key(0)
    state = fit(*settings, data, noise, key=key).state
    return finish(settings.model, state, data, noise, key=key)


def test_a_stream_gives_what_windows_cut_by_hand_give(fitted: FittedARGate) -> None:
    k, t = fitted.config.n_sensors, fitted.config.n_times
    recording = np.random.default_rng(0).normal(size=(t + 3, k))
    recording[t + 1, 2] = np.nan
    stream = SensorStream(fitted)
    answers = [stream.push(sample) for sample in recording]
    assert all(answer is None for answer in answers[: t - 1]) and stream.is_full
    for end, answer in enumerate(answers[t - 1 :], start=t):
        by_hand = fitted.predict(recording[None, end - t : end].transpose(0, 2, 1))
        assert answer is not None
        assert np.array_equal(answer.probabilities, by_hand.probabilities)
        assert np.array_equal(answer.failed, by_hand.failed)
    last = answers[-1]
    assert last is not None and last.failed[0, 2] and last.weights[0, 2] == 0.0


def test_a_sample_of_another_length_is_refused(fitted: FittedARGate) -> None:
    with pytest.raises(ValueError, match=r"sample.shape=\(2,\)"):
        SensorStream(fitted).push([0.0, 1.0])


def test_a_sample_that_is_refused_leaves_no_trace(fitted: FittedARGate) -> None:
    k, t = fitted.config.n_sensors, fitted.config.n_times
    recording = np.random.default_rng(0).normal(size=(t, k))
    stream, clean = SensorStream(fitted), SensorStream(fitted)
    for sample in recording[:-1]:
        assert stream.push(sample) is None and clean.push(sample) is None
    broken = recording[0].copy()
    broken[1] = np.inf
    with pytest.raises(ValueError, match=r"sample\[1\]=inf: expected a finite reading of"):
        stream.push(broken)
    with pytest.raises(TypeError, match="expected one number for each sensor"):
        stream.push(["a"] * k)
    answer, expected = stream.push(recording[-1]), clean.push(recording[-1])
    assert answer is not None and expected is not None
    assert np.array_equal(answer.probabilities, expected.probabilities)


READER = """
import sys, numpy as np
import jax
program = jax.export.deserialize(open(sys.argv[1], "rb").read())
x = np.load(sys.argv[2])
assert not any(name.split(".")[0] == "fusion" for name in sys.modules)
np.savez(sys.argv[3], *program.call(x))
"""


def test_another_process_runs_the_program_without_this_package(
    fitted: FittedARGate, tmp_path: Path
) -> None:
    pytest.importorskip("flatbuffers")
    k, t = fitted.config.n_sensors, fitted.config.n_times
    x = np.random.default_rng(1).normal(size=(5, k, t)).astype(np.float32)
    x[1, 0, 3] = np.nan
    write_program(fitted, tmp_path / "net.stablehlo")
    np.save(tmp_path / "x.npy", x)
    files = [str(tmp_path / name) for name in ("net.stablehlo", "x.npy", "y.npz")]
    code = "import jax.export\n" + READER
    # -I and another folder: neither the working directory nor PYTHONPATH is looked at.
    subprocess.run([sys.executable, "-I", "-c", code, *files], check=True, cwd=tmp_path)
    ours = fitted.predict(x)
    with np.load(tmp_path / "y.npz") as theirs:
        for name, field in zip(
            theirs.files, ("probabilities", "weights", "failure_probability"), strict=True
        ):
            np.testing.assert_allclose(theirs[name], getattr(ours, field), atol=1e-5)


ONNX_READER = """
import sys, numpy as np, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1])
(name,) = (given.name for given in session.get_inputs())
out = session.run(None, {name: np.load(sys.argv[2])})
assert not any(n.split(".")[0] in ("fusion", "jax") for n in sys.modules)
np.savez(sys.argv[3], *out)
"""


def test_a_runtime_without_jax_gives_the_same(fitted: FittedARGate, tmp_path: Path) -> None:
    for name in ("jax2onnx", "onnxruntime"):
        pytest.importorskip(name, reason="pip install 'snn-fusion-failure[onnx]'")
    sizes = fitted.config.n_sensors, fitted.config.n_times
    x = np.random.default_rng(1).normal(size=(5, *sizes)).astype(np.float32)
    x[1, 0, 3] = np.nan
    write_onnx(fitted, tmp_path / "net.onnx", batch=5)
    np.save(tmp_path / "x.npy", x)
    files = [str(tmp_path / name) for name in ("net.onnx", "x.npy", "y.npz")]
    subprocess.run([sys.executable, "-I", "-c", ONNX_READER, *files], check=True, cwd=tmp_path)
    ours = fitted.predict(x)
    with np.load(tmp_path / "y.npz") as theirs:
        for name, field in zip(
            theirs.files, ("probabilities", "weights", "failure_probability"), strict=True
        ):
            np.testing.assert_allclose(theirs[name], getattr(ours, field), atol=1e-5)


def test_a_number_of_windows_is_checked(fitted: FittedARGate, tmp_path: Path) -> None:
    pytest.importorskip("flatbuffers")
    with pytest.raises(ValueError, match="batch=0"):
        write_program(fitted, tmp_path / "net.stablehlo", batch=0)


def test_what_is_no_network_or_cannot_be_written_is_refused(
    fitted: FittedARGate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="snn-fusion-failure"):
        write_program(fitted, tmp_path / "net.stablehlo")
    with pytest.raises(ModuleNotFoundError, match=r"snn-fusion-failure\[onnx\]"):
        write_onnx(fitted, tmp_path / "net.onnx")
