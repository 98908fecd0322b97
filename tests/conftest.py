"""Shared set-up: strict promotion, a compilation cache, the real data when it is there."""

from __future__ import annotations

import contextlib
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
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


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
