"""Shared set-up: strict promotion, compiled programs, parts of the slow tests, the real data."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "agg")

import jax
import pytest

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = Path(__file__).resolve().parent / "golden"

if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


ROOM = 2 * 1024**3
"""Resident memory [bytes] from which compiled programs are dropped between two test files."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--slow-part",
        metavar="I/N",
        help="of the tests marked slow, only every N-th, from the I-th (0 to N - 1)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Compile the programs of the default suite without optimization, which halves its time.

    Most of them run for a moment. The slow tests train, and run what users run.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if config.option.markexpr != "slow" and "backend_optimization_level" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_optimization_level=0".strip()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the slow tests of other parts; the parts are made over all collected ones."""
    text = config.getoption("--slow-part")
    if not text:
        return
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        raise pytest.UsageError(f"--slow-part={text}: expected I/N with I < N, such as 0/3")
    slow = sorted({item.nodeid for item in items if item.get_closest_marker("slow")})
    chosen = {name for i, name in enumerate(slow) if i % int(count) == int(index)}
    left = [item for item in items if item.nodeid in {*slow} - chosen]
    config.hook.pytest_deselected(items=left)
    items[:] = [item for item in items if item not in left]


def _resident() -> int:
    """Memory of this process [bytes]; 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module", autouse=True)
def _memory() -> Iterator[None]:
    """Compiled programs pile up over the files that a worker runs; drop them when they are many."""
    yield
    if _resident() > ROOM:
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)


@pytest.fixture(autouse=True)
def strict_promotion(request: pytest.FixtureRequest) -> Iterator[None]:
    """No silent dtype or rank promotion in our code; `@pytest.mark.relaxed` lifts it."""
    if request.node.get_closest_marker("relaxed"):
        yield
        return
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.numpy_dtype_promotion("strict"))
        stack.enter_context(jax.numpy_rank_promotion("raise"))
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of the real data sets; a test that needs it is skipped without it."""
    folder = os.environ.get("FUSION_DATA_DIR")
    if not folder:
        pytest.skip(
            "real data not at hand: set FUSION_DATA_DIR to the folder of har/, driver/, kitti/"
        )
    path = Path(folder)
    if not path.is_dir():
        pytest.skip(f"FUSION_DATA_DIR={folder} is not a folder")
    return path


@pytest.fixture(scope="session")
def golden() -> Path:
    """The folder of recorded numbers."""
    return GOLDEN
