"""Where data files are looked for; nothing is fetched unless the caller asks for it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

ENVIRONMENT = "FUSION_DATA_DIR"
CACHE_NAME = "snn-fusion-failure"


def cache_dir() -> Path:
    """The user's cache folder of this project (made by the first download)."""
    import pooch

    return Path(pooch.os_cache(CACHE_NAME))


def _roots(data_dir: str | Path | None) -> Iterator[Path]:
    if data_dir is not None:
        root = Path(data_dir).expanduser()
        if not root.exists():
            raise ValueError(
                f"data_dir={str(data_dir)!r} does not exist: give the folder that holds the data "
                "(or the data file itself)"
            )
        yield root
    if os.environ.get(ENVIRONMENT):
        yield Path(os.environ[ENVIRONMENT]).expanduser()
    yield cache_dir()


def locate(name: str, candidates: Sequence[str], data_dir: str | Path | None) -> Path | None:
    """Find the first of several file names in the places where data may lie.

    Order: `data_dir`, `$FUSION_DATA_DIR`, the user cache; in each place first the sub-folder
    `name`, then the place itself. `data_dir` may also be the file (or the unpacked folder).

    Args:
        name: sub-folder of the set, such as `har`.
        candidates: file or folder names, the preferred one first.
        data_dir: the user's folder or file, or None.

    Returns:
        The path, or None when it is in none of the places.

    Raises:
        ValueError: `data_dir` does not exist.
    """
    for root in _roots(data_dir):
        if root.name in candidates or root.is_file():
            return root
        for folder in (root / name, root):
            for candidate in candidates:
                if (folder / candidate).exists():
                    return folder / candidate
    return None


def missing_message(
    name: str, candidates: Sequence[str], data_dir: str | Path | None, remedy: str
) -> str:
    """Say where the set was looked for and every way to get it."""
    given = "not given" if data_dir is None else str(data_dir)
    variable = os.environ.get(ENVIRONMENT) or "not set"
    return (
        f"data set {name!r} not found. Looked for {' or '.join(map(repr, candidates))} in\n"
        f"  1. --data-dir ({given}), itself and its sub-folder {name}/\n"
        f"  2. ${ENVIRONMENT} ({variable})\n"
        f"  3. the user cache ({cache_dir()})\n"
        f"  4. {remedy}\n"
        "Or use --dataset simulated, which needs no file."
    )
