"""What a sweep promises: nothing is lost, mixed, done twice or passed over in silence."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.runs import files
from snn_fusion_failure.sweeps import chunks, definition, leases, plan, worker
from snn_fusion_failure.sweeps.chunkfile import DamagedError, load_chunk
from snn_fusion_failure.sweeps.engine import collect
from snn_fusion_failure.sweeps.folder import chunk_path, done_chunks, held_sweep
from snn_fusion_failure.sweeps.rank import rank, table
from snn_fusion_failure.sweeps.results import setting_scores
from tests.snn_fusion_failure import sweep_toy
from tests.snn_fusion_failure.sweep_toy import NAME, load, same

VARIABLES = ("value", "time", "positive", "status")
TOY = sweep.Config(
    study=NAME, grid=("a=1,2,3,4", "b=0,10"), seeds=3, chunk_size="3", chunk_trials=6, quiet=True
)


def run(out: Path, **changes: Any) -> xr.Dataset:
    sweep.main(dataclasses.replace(TOY, out=out, **changes))
    return load(out)


def stamps(out: Path) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in (out / "chunks").iterdir()}


def arguments(out: Path, **changes: Any) -> list[str]:
    config = dataclasses.replace(TOY, out=out, **changes)
    options = ["--options", *config.options] if config.options else []
    return [
        "--study", NAME, *options, "--grid", *config.grid, "--seeds", str(config.seeds),
        "--chunk-size", "3", "--chunk-trials", "6", "--quiet", "--out", str(out),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    return run(tmp_path_factory.mktemp("whole"))


def test_a_rung_that_failed_is_derived_again(tmp_path, capsys) -> None:
    """One chunk of the second rung raises once; the sweep ends, is shown, and is mended."""
    flag, out = tmp_path / "flag", tmp_path / "out"
    config = dataclasses.replace(
        TOY, out=out, options=(f"broken_while={flag}",), halving=(1, 2), keep=0.5
    )
    opened = sweep.open_sweep(config)
    rung = worker.Worker(opened)
    first = plan.segments_of(plan.read_plan(out))[0]
    for number in range(first.n_chunks(opened)):
        rung.run(first, number)
    flag.touch()  # from the second rung on a == 3 raises
    broken = sweep.main(config)
    assert broken["failed"] or (load(out)["budget"] == 2).any()
    sweep.show(sweep.Show(out, figures=False, page=False))
    flag.unlink()
    mended = sweep.main(dataclasses.replace(config, retry_failed=True))
    assert mended["complete"] and mended["failed"] == 0
    straight = dataclasses.replace(config, out=tmp_path / "straight")
    sweep.main(straight)
    data, wanted = load(out), load(tmp_path / "straight")
    ended = (wanted["status"] == definition.OK).values
    assert ended.sum() == 6
    np.testing.assert_array_equal(data["value"].values[ended], wanted["value"].values[ended])


STUDY = """
import jax

def trial(params, key):
    return {{"level": {level} + params["a"] * jax.random.normal(key)}}
"""


def test_changed_source_is_refused_or_marked(tmp_path, monkeypatch, capsys) -> None:
    path = tmp_path / "changing_study.py"
    path.write_text(STUDY.format(level=0))
    name = f"{path}:trial"
    config = sweep.Config(
        study=name, grid=("a=1,2",), seeds=2, chunk_size="2", quiet=True, out=tmp_path / "out"
    )
    sweep.main(config)

    def forget() -> None:
        for key in [k for k in sys.modules if k.startswith("study_")]:
            del sys.modules[key]

    path.write_text("# the same, with a comment\n" + STUDY.format(level=0))
    forget()
    assert not load_after(config, seeds=3).attrs["mixed"]
    path.write_text(STUDY.format(level=300))
    forget()
    assert sweep.main(dataclasses.replace(config, seeds=3))["complete"]  # nothing is left to mix
    more = dataclasses.replace(config, seeds=4)
    with pytest.raises(ValueError, match=r"changing_study changed.*--allow-mixed"):
        sweep.main(more)
    data = load_after(more, allow_mixed=True)
    assert data.attrs["mixed"] == 1
    assert (data["source"].isel(seed=3) != data["source"].isel(seed=0)).all()
    assert (data["level"].isel(seed=3) > 250).all() and (data["level"].isel(seed=0) < 50).all()
    assert len(json.loads(data.attrs["sources"])) == 2
    assert "several sources are mixed" in table(data, rank(data))


def load_after(config: sweep.Config, **changes: Any) -> xr.Dataset:
    sweep.main(dataclasses.replace(config, **changes))
    return load(config.out)


def test_a_setting_of_which_most_trials_broke_is_not_ranked() -> None:
    """Six of eight trials of the first setting broke; its two lucky ones are the best of all."""
    values = np.array([[9.0] * 2 + [np.nan] * 6, [1.0] * 8, [2.0] * 7 + [np.nan]])
    status = np.where(np.isfinite(values), definition.OK, definition.NON_FINITE)
    data = xr.Dataset(
        {"value": (("a", "seed"), values, {"goal": "max", "units": "1"}),
         "status": (("a", "seed"), status)},
        {"a": ("a", [0.0, 1.0, 2.0], {"units": "1"}), "seed": range(8)},
        {"objective": "value", "min_valid": 0.75, "mixed": 0},
    )  # fmt: skip
    rows = rank(data)
    assert [row["axes"]["a"] for row in rows] == [2.0, 1.0]
    text = table(data, rows)
    assert "a=0: 2 of 8 valid, 6 broken" in text and "fewer than 75% of their seeds" in text
    assert [row["axes"]["a"] for row in rank(data, min_valid=0.25)] == [0.0, 2.0, 1.0]
    # Halving goes by the same numbers.
    scores = setting_scores(values, status, "max", 0.75)
    assert scores.tolist() == [-np.inf, 1.0, 2.0]
    # A status that is not ok does not count, whatever the number is.
    status[2, :3] = definition.FAILED
    assert setting_scores(values, status, "max", 0.75)[2] == -np.inf


def test_failed_or_missing_work_ends_with_status_1(tmp_path, capsys) -> None:
    flag = tmp_path / "flag"
    flag.touch()
    argv = arguments(tmp_path / "out", options=(f"broken_while={flag}",))
    with pytest.raises(SystemExit) as left:
        sweep.cli(argv)
    assert left.value.code == 1
    assert "failed=6 missing=0" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        sweep.cli(argv)  # recorded, not tried again, still no success
    assert left.value.code == 1
    flag.unlink()
    sweep.cli([*argv, "--retry-failed"])
    assert "failed=0 missing=0" in capsys.readouterr().out


def test_workers_from_another_directory_with_a_relative_folder(
    whole, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = sweep.main(dataclasses.replace(TOY, out=Path("runs/a"), workers=2))
    assert found["complete"] and found["missing"] == 0
    same(load(tmp_path / "runs" / "a"), whole, *VARIABLES)


@pytest.mark.parametrize("how", ["truncated", "empty", "flipped"])
def test_a_damaged_chunk_is_named_set_aside_and_computed_again(whole, tmp_path, how, capsys):
    run(tmp_path)
    path = chunk_path(tmp_path, 0, 1)
    data = path.read_bytes()
    middle = len(data) // 2
    path.write_bytes(
        {"truncated": data[:middle], "empty": b"",
         "flipped": data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]}[how]
    )  # fmt: skip
    with pytest.raises(DamagedError, match=r"00000-000001\.npz: damaged"):
        load_chunk(path)
    shown = sweep.show(sweep.Show(tmp_path, figures=False, page=False))["result"]
    assert shown["trials"] == 18 and shown["missing"] == 1
    assert "00000-000001.npz is damaged and left out" in capsys.readouterr().err
    same(run(tmp_path), whole, *VARIABLES)
    assert "00000-000001.npz was damaged; moved to damaged" in capsys.readouterr().err
    assert [p.name for p in (tmp_path / "damaged").iterdir()] == ["00000-000001.npz"]


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_files_follow_the_umask(tmp_path, mask) -> None:
    before = os.umask(mask)
    try:
        files.write_text(tmp_path / "a", "x")
        files.create_once(tmp_path / "b", "x")
        files.append_metrics(tmp_path, {"x": 1})
    finally:
        os.umask(before)
    modes = {stat.S_IMODE(p.stat().st_mode) for p in tmp_path.iterdir()}
    assert modes == {0o666 & ~mask}


def test_every_file_of_a_sweep_follows_the_umask(tmp_path) -> None:
    before = os.umask(0o002)
    try:
        run(tmp_path, grid=("a=1",), seeds=1)
    finally:
        os.umask(before)
    found = {p.name: oct(p.stat().st_mode & 0o777) for p in tmp_path.rglob("*") if p.is_file()}
    assert set(found.values()) == {"0o664"}, found


def _no_link(source: Any, target: Any, **_: Any) -> None:
    raise PermissionError(1, "Operation not permitted", str(source))


def test_without_hard_links_one_writer_still_wins(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "link", _no_link)
    path, won = tmp_path / "sweep.json", []
    gate = threading.Barrier(8)

    def write(number: int) -> None:
        gate.wait()
        if files.create_once(path, f"{number}" * 1000):
            won.append(number)

    threads = [threading.Thread(target=write, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1 and path.read_text() == f"{won[0]}" * 1000
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.json"]
    # The claim of a writer that died is not waited for for ever.
    claim = tmp_path / ".other.json.claim"
    claim.touch()
    os.utime(claim, (0, 0))
    assert files.create_once(tmp_path / "other.json", "x")


def test_with_hard_links_the_later_of_two_writers_is_told_so(tmp_path, monkeypatch) -> None:
    """The other one's file appears between the look and the link."""
    path, link = tmp_path / "sweep.json", os.link

    def late(source: Any, target: Any) -> None:
        Path(target).write_text("theirs")
        link(source, target)

    monkeypatch.setattr(os, "link", late)
    assert files.create_once(path, "mine") is False
    assert path.read_text() == "theirs" and len(list(tmp_path.iterdir())) == 1


def test_a_sweep_runs_where_there_are_no_hard_links(whole, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "link", _no_link)
    same(run(tmp_path), whole, *VARIABLES)


@pytest.mark.parametrize(
    "more",
    [{"seeds": 5}, {"grid": ("a=0.5,1,2,3,4,9", "b=0,10")}, {"grid": ("a=1,2,3,4", "b=0,5,10"),
                                                             "seeds": 4}],
)  # fmt: skip
def test_a_finished_sweep_grows_and_keeps_what_it_has(whole, tmp_path, more) -> None:
    run(tmp_path / "grown")
    before = stamps(tmp_path / "grown")
    grown = run(tmp_path / "grown", **more)
    assert before.items() <= stamps(tmp_path / "grown").items()
    same(grown, run(tmp_path / "fresh", **more), *VARIABLES)
    old = grown.sel({"a": [1, 2, 3, 4], "inner.b": [0, 10], "seed": [0, 1, 2]})
    same(old, whole, *VARIABLES)
    assert len(json.loads(grown.attrs["provenance"])["parts"]) == 2


def test_samples_can_be_added(tmp_path) -> None:
    drawn = {"grid": (), "sobol": ("a=1:2:log", "inner.time=5:100")}
    few = run(tmp_path / "grown", samples=4, **drawn)
    more = run(tmp_path / "grown", samples=7, **drawn)
    same(more.isel(setting=slice(4)), few, *VARIABLES)
    same(more, run(tmp_path / "fresh", samples=7, **drawn), *VARIABLES)


def test_two_commands_share_the_work_and_a_killed_one_is_replaced(tmp_path) -> None:
    """Two processes on one folder begin no chunk twice, but for the one in which one is killed."""
    config = dataclasses.replace(
        TOY, options=("delay=0.01",), grid=("a=1:2:12", "b=1,2"), chunk_trials=3, chunk_size="3"
    )
    whole, out, log = tmp_path / "whole", tmp_path / "out", tmp_path / "log"
    sweep.main(dataclasses.replace(config, out=whole))
    sweep.open_sweep(dataclasses.replace(config, out=out))
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.snn_fusion_failure.sweep_toy"])
    pair = [
        context.Process(target=sweep_toy.work_logged, args=(str(out), str(log))) for _ in range(2)
    ]
    for process in pair:
        process.start()
    limit = time.monotonic() + 120
    while len(done_chunks(out)) < 6 and time.monotonic() < limit:
        time.sleep(0.005)
    pair[0].kill()
    for process in pair:
        process.join()
    assert [p.exitcode for p in pair] == [-9, 0]
    begun = log.read_text().split()
    assert sorted(set(begun)) == [f"00000-{i:06d}" for i in range(24)]
    assert len(begun) - len(set(begun)) <= 1  # the chunk in which the first was killed
    assert sweep.main(dataclasses.replace(config, out=out))["complete"]
    same(load(out), load(whole), *VARIABLES)
    assert leases.held(out) == set()


def test_chunks_that_others_have_are_left_alone_while_there_are_free_ones(
    whole, tmp_path, monkeypatch
) -> None:
    """A crowd does not queue for one chunk: who is late goes where nobody is."""
    held = sweep.open_sweep(dataclasses.replace(TOY, out=tmp_path, chunk_trials=2))
    others = [leases.take(tmp_path, f"00000-{i:06d}", 60.0) for i in range(5)]
    tried, real = [], leases.take

    def take(out: Path, name: str, seconds: float) -> Any:
        tried.append(name)
        return real(out, name, seconds)

    def begun(name: str) -> None:
        if len(done_chunks(tmp_path)) == 6:
            for lease in others:
                assert lease is not None
                lease.release()

    monkeypatch.setattr(chunks.leases, "take", take)
    assert chunks.run_shard(held, on_start=begun).complete
    assert tried == [f"00000-{i:06d}" for i in [*range(5, 12), *range(5)]]
    collect(held)
    same(load(tmp_path), whole, *VARIABLES)


def test_of_a_crowd_that_has_nothing_left_to_claim_most_end(tmp_path, monkeypatch) -> None:
    held = sweep.open_sweep(dataclasses.replace(TOY, out=tmp_path, chunk_trials=2))
    for i in range(12):
        leases.take(tmp_path, f"00000-{i:06d}", 60.0)
    monkeypatch.setattr(chunks, "WATCHERS", 0)
    outcome = chunks.run_shard(held)
    assert not outcome.complete and outcome.errors == ()


def test_a_silent_holder_loses_its_lease(tmp_path) -> None:
    mine = leases.take(tmp_path, "x", 60.0)
    assert mine is not None and leases.take(tmp_path, "x", 60.0) is None
    mine._stop.set()  # as if on a machine that has vanished
    about = json.loads(mine.path.read_text())
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()  # a number that no process here has says nothing about another machine
    mine.path.write_text(json.dumps(about | {"machine": "elsewhere", "pid": ended.pid}))
    assert leases.take(tmp_path, "x", 60.0) is None  # its last sign of life is recent
    os.utime(mine.path, (1, 1))
    theirs = leases.take(tmp_path, "x", 60.0)
    assert theirs is not None and leases.deaths(tmp_path, "x") == 1
    theirs.release()
    assert leases.held(tmp_path) == set()


def test_a_chunk_that_kills_whoever_takes_it_is_given_up(tmp_path) -> None:
    opened = sweep.open_sweep(dataclasses.replace(TOY, out=tmp_path))
    (tmp_path / "dead").mkdir()
    for i in range(leases.DEATHS):
        (tmp_path / "dead" / f"00000-000002.{i}").touch()
    errors = sweep.run(dataclasses.replace(TOY, out=tmp_path), opened)
    assert len(errors) == 1 and "given up: 3 workers died in it" in errors[0]
    found = sweep.main(dataclasses.replace(TOY, out=tmp_path, retry_failed=True))
    assert found["complete"] and found["missing"] == 0


def test_a_raising_setting_fails_alone(whole, tmp_path) -> None:
    """One file holds all settings; a == 3 raises inside the compiled program."""
    flag = tmp_path / "flag"
    flag.touch()
    changes = {"options": (f"broken_while={flag}",), "chunk_trials": 24}
    data = run(tmp_path / "out", **changes)
    assert (data["status"].sel(a=3.0) == definition.FAILED).all()
    healthy = [1.0, 2.0, 4.0]
    same(data.sel(a=healthy), whole.sel(a=healthy), *VARIABLES)
    flag.unlink()
    same(run(tmp_path / "out", retry_failed=True, **changes), whole, *VARIABLES)


def test_a_metric_named_like_an_axis_is_refused_before(tmp_path) -> None:
    for name, message in (
        ("a", "metric='a': expected a name that no axis has"),
        ("status", "metric='status': expected another name"),
    ):
        path = tmp_path / f"clash_{name}.py"
        path.write_text(f"def trial(params, key):\n    return {{'{name}': params['a']}}\n")
        config = sweep.Config(study=f"{path}:trial", grid=("a=1,2",), out=tmp_path / "out")
        with pytest.raises(ValueError, match=message):
            sweep.main(config)
    assert not (tmp_path / "out").exists()


def test_memory_that_runs_out_halves_the_chunk_size(whole, tmp_path, monkeypatch) -> None:
    real, tried = worker.compile_study, []

    def small_memory(study: Any, **given: Any) -> Any:
        program = real(study, **given)

        def call(*args: Any) -> Any:
            tried.append(given["width"])
            if given["width"] > 2:
                raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes")
            return program(*args)

        return call

    monkeypatch.setattr(worker, "compile_study", small_memory)
    data = run(tmp_path, chunk_size="6")
    assert tried[:3] == [6, 3, 2]
    assert (data["status"] == definition.OK).all()
    assert "memory ran out; chunk size 2 from here on" in data.attrs["notes"]
    np.testing.assert_allclose(data["value"], whole["value"], rtol=1e-6)


def test_ctrl_c_says_how_to_go_on(whole, tmp_path, monkeypatch, capsys) -> None:
    real, count = worker.Worker.run, []

    def interrupted(self: Any, segment: Any, number: int, **given: Any) -> Any:
        count.append(number)
        if len(count) == 3:
            raise KeyboardInterrupt
        return real(self, segment, number, **given)

    with monkeypatch.context() as patch:
        patch.setattr(worker.Worker, "run", interrupted)
        with pytest.raises(SystemExit) as left:
            sweep.cli(arguments(tmp_path))
    assert left.value.code == 130
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines == [f"interrupted: finished chunks are in {tmp_path}; the same command goes on"]
    assert len(done_chunks(tmp_path)) == 2 and leases.held(tmp_path) == set()
    same(run(tmp_path), whole, *VARIABLES)


def test_what_can_be_shown_needs_no_study(tmp_path) -> None:
    """The folder says itself what its metrics are: the study may be gone."""
    run(tmp_path)
    text = (tmp_path / "sweep.json").read_text().replace(NAME, "no.longer:there")
    (tmp_path / "sweep.json").write_text(text)
    assert sweep.show(sweep.Show(tmp_path, figures=False, page=False))["result"]["trials"] == 24
    with pytest.raises(ValueError, match="can be imported"):
        held_sweep(tmp_path, load=True)
