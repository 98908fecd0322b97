"""A detector as a program: raw frames in another process give what the package finds."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from fusion.detection.learning.examples import make_example
from fusion.detection.learning.fitting import run_detector
from fusion.detection.learning.stablehlo import resize_image, write_detector
from fusion.detection.learning.training import DetectorState, init_training
from fusion.detection.presets import preset
from tests.fusion.test_detection_network import a_frame

READER = """
import jax, jax.export, sys, numpy as np
program = jax.export.deserialize(open(sys.argv[1], "rb").read())
frame = np.load(sys.argv[2])
assert not any(name.split(".")[0] == "fusion" for name in sys.modules)
np.savez(sys.argv[3], *program.call(*(frame[name] for name in frame.files)))
"""


@pytest.mark.slow
@pytest.mark.parametrize("model", ["dense_argate", "avod"])
def test_another_process_detects_without_this_package(model: str, tmp_path: Path) -> None:
    pytest.importorskip("flatbuffers")
    config = dataclasses.replace(preset("tiny", model).config, score_threshold=0.0)
    frame = a_frame()
    # Blocks of 8 x 8 pixels; where they meet, rounding may differ by a grey level.
    blocks = np.random.default_rng(0).integers(0, 255, (4, 12, 3)).astype(np.uint8)
    frame = frame._replace(image=blocks.repeat(8, axis=0).repeat(8, axis=1))
    example, _ = make_example(config, frame)
    state = jax.jit(partial(init_training, config=config))(jax.random.key(1))
    # Outputs start near zero; larger ones make boxes that differ.
    main = jax.tree.map(lambda a: a + 0.1 * jnp.sin(jnp.arange(a.size)).reshape(a.shape),
                        state.params["main"])  # fmt: skip
    state = state._replace(params=state.params | {"main": main})
    write_detector(config, state, tmp_path / "net.stablehlo", image_size=(32, 96), n_points=700)
    points = np.full((700, 4), np.nan, np.float32)
    points[50 : 50 + len(frame.points)] = frame.points
    np.savez(tmp_path / "x.npz", frame.image, points, example.to_camera, example.p2, example.plane)
    files = [str(tmp_path / name) for name in ("net.stablehlo", "x.npz", "y.npz")]
    # -I and another folder: neither the working directory nor PYTHONPATH is looked at.
    subprocess.run([sys.executable, "-I", "-c", READER, *files], check=True, cwd=tmp_path)
    (ours,) = run_detector(config, state, [example])
    with np.load(tmp_path / "y.npz") as held:
        theirs = [held[name] for name in held.files]
    assert ours.mask.sum() > 1
    # Networks of random weights give scores so close that rounding may change their order.
    order, other = np.argsort(ours.boxes[:, 0]), np.argsort(theirs[0][:, 0])
    ours = ours._replace(boxes=ours.boxes[order], scores=ours.scores[order])
    theirs[:2] = [theirs[0][other], theirs[1][other]]
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(other, mine, atol=0.02)


@pytest.mark.parametrize("shape", [(32, 96), (37, 121), (96, 320)])
def test_images_are_resized_as_examples_are(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)
    wanted = Image.fromarray(image).resize((48, 16), Image.Resampling.BILINEAR)
    got = jax.jit(partial(resize_image, size=(16, 48)))(image)
    assert np.abs(255 * np.asarray(got) - np.asarray(wanted, np.float32)).max() < 1.01


def test_the_oracle_and_empty_frames_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, state = preset("tiny", "dense_oracle").config, DetectorState({}, {}, {}, jnp.zeros(()))
    with pytest.raises(ValueError, match="model='dense_oracle': expected a detector that is not"):
        write_detector(config, state, tmp_path / "x", image_size=(32, 96))
    config = preset("tiny", "dense").config
    with pytest.raises(ValueError, match=r"n_points=0: expected at least 1"):
        write_detector(config, state, tmp_path / "x", image_size=(32, 96), n_points=0)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="snn-fusion-failure"):
        write_detector(config, state, tmp_path / "x", image_size=(32, 96))
