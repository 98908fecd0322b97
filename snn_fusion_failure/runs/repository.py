"""Where the checkout is, if this is one; where results are read from; where programs are kept."""

from __future__ import annotations

import os
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent
ROOT = PACKAGE.parent
IS_CHECKOUT = (ROOT / "pyproject.toml").is_file() and (ROOT / "results").is_dir()
"""False for an installed wheel, which has neither scripts nor a place for results of record."""
RESULTS = ROOT / "results" if IS_CHECKOUT else PACKAGE / "results"
"""Results of record; the wheel carries a copy, to be read only."""
RECORD = RESULTS.resolve()
"""The same, whatever a test puts in its place."""


def require_checkout(option: str) -> None:
    """Refuse what writes into the repository when there is none.

    Raises:
        ValueError: this is an installed package.
    """
    if not IS_CHECKOUT:
        raise ValueError(
            f"{option}: expected a checkout of the repository, whose results/ it writes; this is "
            f"the installed package in {ROOT}; leave the option out, or run it in a clone"
        )


def cache_folder() -> Path:
    """Where compiled programs are kept: in the checkout, or in the user's cache folder."""
    if IS_CHECKOUT:
        return ROOT / ".cache" / "jax"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "snn-fusion-failure" / "jax"


def enable_compilation_cache() -> None:
    """Keep compiled programs between runs, unless the user has set a cache of their own."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
