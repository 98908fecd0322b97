"""Data sets of sensor windows; reading is strict, and nothing is fetched unless asked for."""

from __future__ import annotations

from pathlib import Path

from fusion._checks import check_choice
from fusion.data.arrays import from_arrays
from fusion.data.dataset import Dataset, validation_split
from fusion.data.driver import load_driver
from fusion.data.har import load_har
from fusion.data.simulated import load_simulated

__all__ = ["DATASETS", "Dataset", "from_arrays", "load", "validation_split"]

# Ways to split each set into training and test rows, the default first.
DATASETS: dict[str, tuple[str, ...]] = {
    "har": ("subject",),
    "driver": ("random", "trip"),
    "simulated": ("subject",),
}


def load(
    name: str,
    data_dir: str | Path | None = None,
    *,
    download: bool = False,
    split: str | None = None,
    features: str | None = None,
    seed: int = 0,
) -> Dataset:
    """Load a data set by name.

    Args:
        name: `har`, `driver` or `simulated`.
        data_dir: folder or file to look at first; then `$FUSION_DATA_DIR` and the user cache.
        download: fetch the set from its publisher when it is nowhere (`har` only).
        split: how test rows are taken, one of `DATASETS[name]`; None = the first of them.
        features: which signals, see `load_driver` (`driver` only).
        seed: of the simulated values, or of the draw of the driver's test rows.

    Returns:
        The set, scaled to [-1, 1] by training statistics.

    Raises:
        ValueError: unknown name or split (the message lists the known ones), or a damaged file.
        FileNotFoundError: the set is nowhere; the message lists the ways to get it.

    Example:
        >>> load("simulated").channels[:2]
        ('sensor_0', 'sensor_1')
    """
    check_choice("name", name, DATASETS)
    split = DATASETS[name][0] if split is None else split
    check_choice("split", split, DATASETS[name])
    if features is not None and name != "driver":
        raise ValueError(
            f"features={features!r}: expected name='driver' with it, {name!r} has one list of "
            "channels; leave it out"
        )
    if name == "har":
        return load_har(data_dir, download=download)
    if name == "driver":
        return load_driver(data_dir, split=split, features=features or "complete", seed=seed)
    return load_simulated(seed=seed)
