"""One CPU and one thread for a benchmark, set before the libraries that it times are imported."""

from __future__ import annotations

import os


def pin(core: int | None) -> int:
    """Confine the process to one CPU and the libraries to one thread; before they are imported.

    Args:
        core: number of the CPU; the first that is allowed when None.

    Returns:
        The CPU; -1 where the system cannot confine a process and none was named.
    """
    if hasattr(os, "sched_setaffinity"):
        core = min(os.sched_getaffinity(0)) if core is None else core
        os.sched_setaffinity(0, {core})
    single = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    held = os.environ.get("XLA_FLAGS", "")
    if single not in held:
        os.environ["XLA_FLAGS"] = f"{held} {single}".strip()
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    return -1 if core is None else core
