"""Frames of a training step shared by local devices."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fusion.detection.learning.fitting import fit_detector
from fusion.detection.learning.sharding import frame_mesh
from fusion.detection.learning.training import DetectorTrainConfig
from fusion.detection.presets import preset


def test_what_cannot_be_shared_is_refused_before_anything_is_read() -> None:
    assert frame_mesh(1, 3) is None
    with pytest.raises(ValueError, match="devices=0: expected at least 1"):
        frame_mesh(0, 1)
    with pytest.raises(ValueError, match=r"devices=1024: expected at most \d+, the local devices"):
        frame_mesh(1024, 1024)

    def read(frame: int) -> None:
        raise AssertionError("a frame was read")

    tiny = preset("tiny")
    train = DetectorTrainConfig(steps=1, batch_size=3)
    with pytest.raises(ValueError, match="batch_size=3: expected a multiple of devices=2"):
        fit_detector(tiny.config, train, tiny.params, 1, read, devices=2)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.relaxed
def test_two_devices_have_the_gradient_of_one_with_half_the_work(tmp_path: Path) -> None:
    given = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu",
    }  # fmt: skip
    ran = subprocess.run(
        [sys.executable, "-m", "tests.fusion._sharded_steps", str(tmp_path)],
        env=given, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr[-3000:]
    one, two = (np.load(tmp_path / f"gradients_{n}.npz") for n in (1, 2))
    assert set(one.files) == set(two.files) and len(one.files) > 20
    largest = max(np.abs(one[name]).max() for name in one.files)
    assert np.isfinite(largest) and largest > 0.1
    for name in one.files:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-5, atol=1e-5, err_msg=name)
    alone, shared = json.loads(ran.stdout.splitlines()[-1])
    assert shared < 0.6 * alone
