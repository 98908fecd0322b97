"""Where the checkout is, if this is one: the folder of `results/` and of the compilation cache."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
RESULTS = ROOT / "results"


def enable_compilation_cache() -> None:
    """Keep compiled programs in `.cache/jax`, unless the user has set a cache of their own."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
