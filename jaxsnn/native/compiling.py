"""Compiling `window.cc` with the user's own compiler, once for each machine and version of it.

The library lies in the user's cache folder under a name that says what it was made from: source,
compiler, options, processor and the version of jaxlib whose headers it saw.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax
import jaxlib

SOURCE = Path(__file__).with_name("window.cc")
TARGETS = ("jaxsnn_fire", "jaxsnn_remember")
# Sums in the order in which they are written, products and sums contracted by std::fma only.
OPTIONS = (
    "-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math",
    "-std=c++17", "-fPIC", "-shared",
)  # fmt: skip


def compiler() -> str:
    """Path of the C++ compiler: `$CXX`, else c++, g++ or clang++.

    Raises:
        ValueError: there is none.
    """
    named = os.environ.get("CXX")
    names = (named,) if named else ("c++", "g++", "clang++")
    for name in names:
        found = shutil.which(name)
        if found:
            return found
    raise ValueError(
        f"CXX={named}: expected a C++ compiler for engine='native', there is no "
        f"{' and no '.join(names)}; install one, name it in CXX, or take engine='xla'"
    )


def cache_folder() -> Path:
    """Where libraries are kept."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "snn-fusion-failure" / "native"


def _processor() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        return platform.processor()


def library() -> Path:
    """The compiled library, made now unless it is there already.

    Raises:
        ValueError: there is no compiler, or it refuses the source; its words are in the message.
    """
    program = compiler()
    version = subprocess.run([program, "--version"], capture_output=True, text=True).stdout
    parts = (SOURCE.read_text(), version, *OPTIONS, platform.machine(), _processor(),
             jaxlib.__version__)  # fmt: skip
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    path = cache_folder() / f"window-{digest}.so"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        command = [program, *OPTIONS, f"-I{jax.ffi.include_dir()}", str(SOURCE), "-o", str(made)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ValueError(
                f"CXX={program}: expected it to compile {SOURCE.name}, it ended with "
                f"{done.returncode}; name another one in CXX or take engine='xla'\n"
                f"{done.stderr[-2000:]}"
            )
        # In one step, so that two processes at once do no harm.
        made.replace(path)
    return path


@functools.cache
def register() -> None:
    """Compile, load and announce the calls to XLA, once per process."""
    loaded = ctypes.CDLL(str(library()))
    for name in TARGETS:
        handler = jax.ffi.pycapsule(getattr(loaded, name))
        jax.ffi.register_ffi_target(name, handler, platform="cpu")
