"""Launchers: local processes, SLURM's local stand-in, Ray with a worker that is killed."""

from __future__ import annotations

import dataclasses
import os

import pytest
import xarray as xr

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.sweeps import launchers
from snn_fusion_failure.sweeps.engine import collect
from tests.snn_fusion_failure.sweep_toy import NAME, load, same

# Ray and submitit warn about what is not ours to mend.
pytestmark = pytest.mark.filterwarnings("ignore")

VARIABLES = ("value", "time", "positive", "status")
CONFIG = sweep.Config(
    study=NAME, options=("delay=0.02",), grid=("a=1:2:10", "b=1,2"), seeds=3, chunk_size="2",
    chunk_trials=4, quiet=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    out = tmp_path_factory.mktemp("alone")
    sweep.main(dataclasses.replace(CONFIG, out=out))
    return load(out)


def test_local_workers(alone, tmp_path) -> None:
    result = sweep.main(dataclasses.replace(CONFIG, out=tmp_path, workers=2))
    assert result["complete"] and result["failed"] == 0
    same(load(tmp_path), alone, *VARIABLES)


def test_a_local_worker_that_dies_is_reported(alone, tmp_path) -> None:
    """Its chunk is taken over by the other one; the death is told and counted."""
    die = tmp_path / "die"
    die.touch()
    config = dataclasses.replace(CONFIG, options=("delay=0.02", f"die={die}"), workers=2)
    config = dataclasses.replace(config, out=tmp_path / "out")
    made = sweep.open_sweep(config)
    errors = sweep.run(config, made)
    assert len(errors) == 1 and errors[0].endswith("ended with status -9")
    # The other worker took the dead one's chunk over.
    assert collect(made)[1]["complete"]
    assert len(list((made.out / "dead").iterdir())) == 1
    same(load(tmp_path / "out"), alone, *VARIABLES)


def test_submitit_array(alone, tmp_path) -> None:
    config = dataclasses.replace(
        CONFIG, out=tmp_path, launcher="submitit", workers=2, cluster="local",
        slurm=("timeout_min=5",),
    )  # fmt: skip
    result = sweep.main(config)
    assert result["complete"] and result["failed"] == 0
    assert len(list((tmp_path / "jobs").glob("*_result.pkl"))) == 2
    same(load(tmp_path), alone, *VARIABLES)


@pytest.mark.slow
def test_ray_goes_on_when_a_worker_is_killed(alone, tmp_path, monkeypatch) -> None:
    """SIGKILL for the first actor that has ended a chunk, while it works on its next one."""
    monkeypatch.setenv("RAY_worker_niceness", "0")  # 15 by default: starved on a busy machine
    made = sweep.open_sweep(dataclasses.replace(CONFIG, out=tmp_path))
    pids: list[int] = []

    def kill_first(pid: int) -> None:
        if not pids:
            os.kill(pid, 9)
        pids.append(pid)

    counts = []
    errors = launchers.launch_ray(
        made, 2, lambda progress: counts.append(progress.done), on_pid=kill_first
    )
    assert errors == []
    assert len(set(pids)) >= 2 and pids[0] not in pids[1:]
    assert collect(made)[1]["complete"]
    same(load(tmp_path), alone, *VARIABLES)
