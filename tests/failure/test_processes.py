"""No simulator outlives its time limit, its batch, or the process that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from failure import FunctionSimulator
from failure.simulators import processes
from failure.simulators.processes import Group, SimulatorError

SIMULATOR = "echo $$ >> {pids}; sleep 300 & echo $! >> {pids}; wait"
"""A simulator that starts another program and hangs."""

PARENT = """
import importlib.util, signal, sys
# A shell starts what it puts in the background, and its children, with this signal ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
spec = importlib.util.spec_from_file_location("processes", sys.argv[1])
module = importlib.util.module_from_spec(spec)
sys.modules["processes"] = module
spec.loader.exec_module(module)
module.Group().run(["sh", "-c", sys.argv[2]], timeout=1200.0)
"""


def running(pid: int) -> bool:
    """Whether a process is there; one that has ended and is not collected yet is not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def started(path: Path, count: int) -> list[int]:
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        words = path.read_text().split() if path.exists() else []
        if len(words) >= count:
            return [int(w) for w in words]
        time.sleep(0.02)
    raise AssertionError("the simulator did not start")


def gone(pids: list[int]) -> bool:
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        if not any(running(p) for p in pids):
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_when_the_parent_ends(how: signal.Signals, tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, processes.__file__, SIMULATOR.format(pids=pids)],
        stderr=subprocess.DEVNULL,
    )
    children = started(pids, 2)
    assert all(running(p) for p in children)
    parent.send_signal(how)
    parent.wait(30)
    assert gone(children)


def test_a_time_limit_ends_what_the_program_has_started(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    done = Group().run(["sh", "-c", SIMULATOR.format(pids=pids)], timeout=5.0)
    assert done.returncode is None and done.seconds < 60.0
    assert gone(started(pids, 2))


def test_a_good_end_leaves_no_background_process(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    done = Group().run(["sh", "-c", f"sleep 300 & echo $! > {pids}; echo good"], timeout=60.0)
    assert done.stdout == "good\n" and done.returncode == 0 and done.seconds < 30.0
    assert gone(started(pids, 1))


def test_a_group_that_was_ended_starts_nothing_more() -> None:
    group = Group()
    group.end()
    with pytest.raises(SimulatorError, match="ended"):
        group.run(["true"], timeout=1.0)


def test_output_in_another_encoding_is_read() -> None:
    done = Group().run(["printf", r"gain = 5\xb0"], timeout=10.0)
    assert done.stdout.startswith("gain = 5")


def hang(x: np.ndarray) -> list[float]:
    Path(os.environ["HANG_PIDS"]).write_text(str(os.getpid()))
    time.sleep(300)
    return [0.0]


@pytest.mark.slow
def test_worker_processes_of_a_function_end_with_the_parent(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    code = (
        "import numpy as np, tests.failure.test_processes as t\n"
        "if __name__ == '__main__':\n"
        "    t.FunctionSimulator(t.hang, 1, timeout=1200)(np.zeros((1, 1)))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "HANG_PIDS": str(pids), "PYTHONPATH": root}
    parent = subprocess.Popen([sys.executable, str(script)], env=environment)
    children = started(pids, 1)
    parent.kill()
    parent.wait(30)
    assert gone(children)
    assert FunctionSimulator is not None
