"""One device, two devices, two processes: the same numbers."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.runs import repository
from tests.snn_fusion_failure.sweep_toy import load, same

VARIABLES = ("rate", "error", "status")
ARGS = [
    "scripts/sweep.py", "--study", "lif", "--options", "steps=60", "--grid", "drive=18:40:5",
    "tau_m=5,20,40", "--seeds", "3", "--chunk-trials", "10", "--quiet",
]  # fmt: skip
CONFIG = sweep.Config(
    study="lif", options=("steps=60",), grid=("drive=18:40:5", "tau_m=5,20,40"), seeds=3,
    chunk_size="4", chunk_trials=10, quiet=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def one_device(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    import dataclasses

    out = tmp_path_factory.mktemp("one")
    sweep.main(dataclasses.replace(CONFIG, out=out))
    return load(out)


def start(out: Path, *args: str, devices: int = 1, **extra: str) -> subprocess.Popen:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", **extra}
    return subprocess.Popen(
        [sys.executable, *ARGS, "--out", str(out), *args],
        cwd=repository.ROOT, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def ended(process: subprocess.Popen) -> str:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out


def test_two_devices_are_one_device(one_device, tmp_path) -> None:
    """Chunks of 10 trials do not divide by two devices times 3."""
    text = ended(start(tmp_path, "--chunk-size", "3", devices=2))
    assert text.splitlines()[-1].startswith("result: complete=True trials=45 of=45")
    same(load(tmp_path), one_device, *VARIABLES)


def test_two_processes_are_one_process(one_device, tmp_path) -> None:
    """One program over the devices of two processes, as on two machines."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    processes = [
        start(
            tmp_path, "--chunk-size", "3", "--distributed", "--coordinator", f"127.0.0.1:{port}",
            "--processes", "2", "--process", str(i), devices=2,
        )
        for i in range(2)
    ]  # fmt: skip
    texts = [ended(p) for p in processes]
    assert "complete=True trials=45" in texts[0]
    same(load(tmp_path), one_device, *VARIABLES)
