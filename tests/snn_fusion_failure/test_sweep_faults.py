"""Kill -9: twenty times at random moments, and the result is that of a sweep left alone."""

from __future__ import annotations

import dataclasses
import multiprocessing
import random
import time
from pathlib import Path
from typing import Any

import pytest

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.sweeps.folder import done_chunks
from tests.snn_fusion_failure import sweep_toy

KILLS = 20
CONFIG = sweep.Config(
    study=sweep_toy.NAME, options=("delay=0.005",), grid=("a=1:2:30", "b=1,2"), seeds=8,
    chunk_size="2", chunk_trials=2, quiet=True,
)  # fmt: skip


def stamps(out: Path) -> dict[str, tuple[int, int]]:
    """Name -> inode and time of each finished chunk: what a second writing would change."""
    found = {}
    for path in (out / "chunks").glob("[0-9]*.npz"):
        stat = path.stat()
        found[path.name] = (stat.st_ino, stat.st_mtime_ns)
    return found


@pytest.mark.slow
def test_twenty_kills_change_nothing(tmp_path) -> None:
    whole, out, log = tmp_path / "whole", tmp_path / "killed", tmp_path / "log"
    sweep.main(dataclasses.replace(CONFIG, out=whole))
    sweep.open_sweep(dataclasses.replace(CONFIG, out=out))
    total = 240
    # A server that has imported everything forks the workers: each start is cheap and clean.
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.snn_fusion_failure.sweep_toy"])
    rng = random.Random(0)
    in_flight = 0
    for kill in range(KILLS):
        before = stamps(out) if kill else {}
        process = context.Process(target=sweep_toy.work_logged, args=(str(out), str(log)))
        process.start()
        if kill % 5 == 4:
            time.sleep(rng.uniform(0.0, 1.0))  # while it starts, mostly
        else:
            # After some chunks, anywhere within the next one: running, writing or renaming.
            wanted = len(before) + rng.randint(1, 6)
            while len(done_chunks(out)) < wanted and process.is_alive():
                time.sleep(0.005)
            time.sleep(rng.uniform(0.0, 0.02))
        assert process.is_alive(), "the sweep ended before it could be killed: make it longer"
        process.kill()
        process.join()
        assert process.exitcode == -9
        now = stamps(out)
        assert before.items() <= now.items()  # nothing finished is touched again
        begun = len(log.read_text().splitlines()) if log.exists() else 0
        in_flight = begun - len(now)
        assert in_flight <= kill + 1  # at most the chunk in flight is lost, each time
    left = len(stamps(out))
    assert 0 < left < total
    result = sweep.main(dataclasses.replace(CONFIG, out=out))
    assert result["complete"] and result["trials"] == 480
    # The first and the last process ran each chunk once, but for those in flight at a kill.
    begun = log.read_text().splitlines()
    assert len(begun) - len(set(begun)) <= in_flight
    names = ("value", "time", "positive", "status")
    sweep_toy.same(sweep_toy.load(whole), sweep_toy.load(out), *names)
