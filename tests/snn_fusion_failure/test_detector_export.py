"""`train_detector.py export`: a run as a program, and the recipe for a small trained detector."""

from __future__ import annotations

import subprocess
from functools import partial
from pathlib import Path

import jax
import jax.export
import numpy as np
import pytest

from fusion.detection.kitti.files import read_frame
from fusion.detection.learning.cache import prepare_cache
from fusion.detection.learning.checkpoints import Checkpoints
from fusion.detection.learning.fitting import run_detector
from fusion.detection.learning.training import init_training
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import train_detector as command
from snn_fusion_failure.commands.detector_runs import NOT_SETTINGS, build
from snn_fusion_failure.runs import open_run
from tests.snn_fusion_failure.test_train_detector import write_frame

MAKEFILE = Path(__file__).resolve().parents[2] / "Makefile"


@pytest.mark.slow
def test_a_run_becomes_a_program_for_the_images_it_was_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("flatbuffers")
    root, run = tmp_path / "kitti", tmp_path / "run"
    write_frame(root, "000000", 0)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("000000\n")
    cache = prepare_cache(root, root / "cache_tiny", "tiny", splits=("train",), any_size=True)
    options = choices.Export(root, "dense_argate", "tiny", run=run, points=600)
    with pytest.raises(FileNotFoundError, match="holds no run: run `train` first"):
        command.main(options)
    trained = choices.Train(root, "dense_argate", "tiny", steps=1)
    fields = vars(trained).items()
    open_run(run, {k: v for k, v in fields if k not in NOT_SETTINGS})
    config = build(trained, cache).config
    state = jax.jit(partial(init_training, config=config))(jax.random.key(0))
    checkpoints = Checkpoints(run / "checkpoints")
    checkpoints.save(1, state, [])
    checkpoints.close()
    result = command.main(options)
    assert (result["rows"], result["columns"], result["points"]) == (32, 96, 600)
    assert capsys.readouterr().out.splitlines()[-1].startswith("result: program=")
    program = jax.export.deserialize((run / "detector.stablehlo").read_bytes())
    frame, (example,) = read_frame(root, "000000", any_size=True), cache.read("train")
    points = np.full((600, 4), np.nan, np.float32)
    points[: len(frame.points)] = frame.points
    geometry = example.to_camera, example.p2, example.plane
    theirs = program.call(frame.image, points, *geometry)
    (ours,) = run_detector(config, state, [example])
    np.testing.assert_allclose(theirs[3], ours.weights, atol=0.01)
    np.testing.assert_allclose(theirs[4], ours.failed, atol=0.02)


def test_the_recipe_of_a_trained_detector_is_commands_that_parse() -> None:
    """`make -n` prints what would be run; each command is read as the command line would be."""
    import shlex

    import tyro

    said = subprocess.run(
        ["make", "-n", "-f", str(MAKEFILE), "-o", ".venv/.run", "detector"],
        check=True, capture_output=True, text=True, cwd=MAKEFILE.parent,
    ).stdout.replace("\\\n", " ")  # fmt: skip
    found = []
    for line in said.splitlines():
        if "train_detector.py" in line:
            words = shlex.split(line.split("train_detector.py", 1)[1])
            parsed = tyro.cli(command.Command, args=words)  # type: ignore[call-overload]
            found.append(type(parsed).__name__)
            assert parsed.size == "small" and parsed.data == Path("runs/detector_frames")
    assert found == ["Prepare", "Train", "Eval", "Export"]
