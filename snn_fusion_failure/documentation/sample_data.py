"""Made-up data sets and simulated frames for the commands of the documentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def make_data(folder: Path) -> None:
    """Data sets with the published shapes and random values, as `$FUSION_DATA_DIR`."""
    import csv

    import numpy as np

    from fusion.data.driver import (
        DRIVER_CHANNELS,
        DRIVER_CLASSES,
        DRIVER_SOURCE_CHANNELS,
        DRIVER_TAGGED_CHANNELS,
        N_ROWS,
        N_TRIPS,
        OIL,
        OIL_IN_FILE,
    )
    from fusion.data.har import COUNTS, N_TIME

    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {}
    for part, subjects in (("train", range(1, 22)), ("test", range(22, 31))):
        labels = rng.permutation(np.repeat(np.arange(1, 7), COUNTS[part]))
        noise = rng.normal(size=(len(labels), 9, N_TIME))
        arrays[f"X_{part}"] = (noise + 0.5 * labels[:, None, None]).astype(np.float32)
        arrays[f"y_{part}"] = labels.astype(np.int8)
        arrays[f"subject_{part}"] = np.resize(np.array(subjects), len(labels)).astype(np.int8)
    (folder / "har").mkdir(parents=True)
    np.savez(folder / "har" / "uci_har_inertial.npz", **arrays)

    signals = sorted({*DRIVER_CHANNELS, *DRIVER_TAGGED_CHANNELS, *DRIVER_SOURCE_CHANNELS})
    # Two trips for each driver, then one more each for as long as there are trips.
    drivers = [DRIVER_CLASSES[i % len(DRIVER_CLASSES)] for i in range(N_TRIPS)]
    lengths = [N_ROWS // N_TRIPS + (i < N_ROWS % N_TRIPS) for i in range(N_TRIPS)]
    values = rng.integers(0, 100, size=(N_ROWS, len(signals))).tolist()
    (folder / "driver").mkdir()
    path = folder / "driver" / "hcrl_kia_soul.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [OIL_IN_FILE if name == OIL else name for name in signals]
        writer.writerow([*names, "Time(s)", "Class"])
        rows = iter(values)
        for driver, length in zip(drivers, lengths, strict=True):
            writer.writerows([*next(rows), second + 1, driver] for second in range(length))


def make_frames(folder: Path) -> None:
    """Simulated frames under the names that the documentation gives to KITTI folders."""
    from snn_fusion_failure.commands import simulate_kitti

    runs = folder / "runs"
    simulate_kitti.main(
        simulate_kitti.Config(out=runs / "kitti", frames=6, val=3, test=0, size="tiny")
    )
    (folder / "data").mkdir(exist_ok=True)
    for link in (runs / "kitti_real", folder / "data" / "kitti"):
        link.symlink_to(runs / "kitti", target_is_directory=True)
