"""The simulation behind the scaling numbers has the known limits of a queue; costs add up."""

from __future__ import annotations

import dataclasses
import os

import pytest

from snn_fusion_failure.sweeps.capacity import in_processes
from snn_fusion_failure.sweeps.queueing import simulate
from tests._scripts import load_script

bench_sweep = load_script("benchmarks/bench_sweep")


def test_one_worker_never_waits() -> None:
    one = simulate(1, 2.0, 0.5, spread=0.3)
    assert one["wait_s"] == 0.0
    assert one["efficiency"] == pytest.approx(2.0 / 2.5, rel=0.1)


@pytest.mark.parametrize("way", ["dealt", "queue"])
def test_a_saturated_folder_serves_at_its_own_rate(way) -> None:
    """Far beyond c / f + 1 workers the folder never rests: the rate is 1 / f."""
    chunk_s, file_s, workers = 1.0, 0.1, 200
    held = simulate(workers, chunk_s, file_s, spread=0.0, way=way)
    # All 20 x 200 files, one after another, after the first chunks.
    wanted = 20 * workers * chunk_s / (workers * (chunk_s + 20 * workers * file_s))
    assert held["efficiency"] == pytest.approx(wanted, rel=1e-9)


def test_below_saturation_waits_are_short() -> None:
    few = simulate(20, 10.0, 0.01)
    assert few["wait_s"] < 0.01
    assert few["efficiency"] < 1.0


def test_one_queue_balances_better_than_dealing_out() -> None:
    dealt, queue = (simulate(100, 10.0, 1e-3, way=w)["efficiency"] for w in ("dealt", "queue"))
    assert queue > dealt


def test_leases_balance_as_a_queue_does_while_claims_are_cheap() -> None:
    costs = {"claim_s": 1e-4, "entry_s": 1e-7}
    leases = simulate(100, 10.0, 1e-3, way="leases", **costs)
    queue = simulate(100, 10.0, 1e-3, way="queue")["efficiency"]
    assert leases["efficiency"] == pytest.approx(queue, rel=0.02)
    # At least the look with which everybody begins and the one that finds nothing left.
    assert 2 / 20 <= leases["looks"] < 2
    # Alone, without costs of its own: the folder's file is all that a worker waits for.
    alone = simulate(1, 2.0, 0.5, spread=0.0, way="leases")
    assert alone["efficiency"] == pytest.approx(2.0 / 2.5) and alone["wait_s"] == 0.0


def test_a_saturated_folder_serves_claims_and_files_one_after_another() -> None:
    held = simulate(50, 0.1, 1e-2, way="leases", claim_s=1e-2)
    # 1,000 chunks, each with a claim and a file; misses and looks come on top of that.
    bound = 1000 * 0.1 / (50 * 1000 * 2e-2)
    assert 0.8 * bound < held["efficiency"] < 1.05 * bound  # the mean of drawn times is not 0.1


def test_measurements_on_a_small_folder(tmp_path) -> None:
    config = dataclasses.replace(
        bench_sweep.Config(), folder=tmp_path, repeats=5, writers=(1,), workers=(), chunks=2,
        snn=False, simulated=(1, 10), out=tmp_path / "bench.json",
    )  # fmt: skip
    result = bench_sweep.main(config)
    assert result["chunk"]["1024 trials"]["bytes"] > result["chunk"]["16 trials"]["bytes"]
    assert result["file_s"] == 1.0 / result["files_per_second_by_writers"]["1"]
    many, few = (result["engine"][f"{n} trials a chunk"] for n in (1024, 16))
    assert 0.0 < many["overhead_ms_per_trial"] < few["overhead_ms_per_trial"]
    assert len(result["simulated"]) == 2 * 3 * 2 * 3
    assert [p.name for p in tmp_path.iterdir()] == ["bench.json"]  # tidied up


def test_a_process_that_dies_is_an_error_and_not_a_wait() -> None:
    with pytest.raises(RuntimeError, match=r"_exit.*a process died"):
        in_processes(os._exit, [(3,)], 1)


def test_a_function_that_no_process_can_import_is_an_error_and_not_a_wait() -> None:
    with pytest.raises(RuntimeError, match="a new process can import"):
        in_processes(bench_sweep.sweep_times, [()], 1)
