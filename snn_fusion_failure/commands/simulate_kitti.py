"""Simulate camera and lidar frames of streets as a KITTI folder.

    python scripts/simulate_kitti.py --layouts KITTI/training/label_2 --frames 400 --val 100 \
        --size small --out runs/kitti_simulated --seed 0

`--layouts` takes positions, sizes and headings from label files of the benchmark (image and lidar
files are not needed); without it they come from a model fitted to those. Writes
`OUT/training/{image_2,velodyne,calib,label_2,planes}`, `OUT/ImageSets/{train,val,test}.txt`, for
each frame a table of what each sensor saw (`training/visibility`), and `simulation.json`. Layouts
of the three lists differ. Some 0.15 CPU-seconds a frame for `small` (320x96 pixels, a third of the
lidar's shots), after 8 seconds of compiling; `paper` (1242x375, all shots) casts four times as many
rays. `--resume` goes on with a run that was cut off. Last line:
`result: frames=... cars=... points_per_frame=...`.

`--picture FILE.png` draws the first four training frames: image with boxes, bird's-eye view.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    open_run,
    progress,
    write_json,
)
from snn_fusion_failure.runs.command import run_command

SPLITS = ("train", "val", "test")


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the simulation."""

    out: Path
    """Folder to write."""
    layouts: Path | None = None
    """Folder of KITTI label files (`label_2`); a fitted model of them is used without it."""
    frames: int = 400
    """Training frames."""
    val: int = 100
    """Validation frames."""
    test: int = 100
    """Test frames; labelled as well."""
    size: Literal["tiny", "small", "paper"] = "small"
    """`tiny` is for trying things out: 192x58 pixels, a quarter of the shots."""
    seed: int = 0
    dark_paint: float = 0.2
    """Share of vehicles and look-alikes that the lidar hardly sees."""
    low_contrast: float = 0.15
    """Share of vehicles that the camera hardly sees."""
    night: float = 0.15
    """Share of frames without light for the camera."""
    look_alikes: int = 6
    """At most so many car-shaped bushes and containers in a frame."""
    batch_size: int | None = None
    """Frames rendered side by side; for accelerators."""
    resume: bool = False
    overwrite: bool = False
    picture: Path | None = None
    """Draw the first four training frames to this file."""


def _settings(config: Config) -> dict[str, Any]:
    output = ("out", "batch_size", "resume", "overwrite", "picture", "layouts")
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in output}
    # The folder's own place is nobody's business, and may differ when a run goes on.
    return {**settings, "layouts": "label files" if config.layouts else "fitted model"}


def main(config: Config) -> dict[str, Any]:
    """Write the folder; returns counts and times."""
    counts = (config.frames, config.val, config.test)
    if config.frames < 1 or min(counts) < 0 or sum(counts) > 1_000_000:
        raise ValueError(
            f"frames={config.frames}, val={config.val}, test={config.test}: expected at least one "
            "training frame, and at most a million in all"
        )
    from fusion.detection.simulator.scene import SceneConfig

    scene_config = SceneConfig(
        max_look_alikes=config.look_alikes,
        dark_paint=config.dark_paint,
        low_contrast=config.low_contrast,
        night=config.night,
    )
    from fusion.detection.kitti.files import write_split
    from fusion.detection.simulator.frames import simulate_frames, split_layouts, write_frame
    from fusion.detection.simulator.layouts import read_layouts
    from fusion.detection.simulator.rendering import SIZES, nominal_calibration

    enable_compilation_cache()
    sensor_config = SIZES[config.size]
    # Layouts are read before the folder is claimed: a wrong path leaves nothing behind.
    layouts = read_layouts(config.layouts) if config.layouts else []
    pools = split_layouts(layouts, counts, config.seed) if layouts else [[] for _ in counts]
    open_run(config.out, _settings(config), resume=config.resume, overwrite=config.overwrite)
    folder = config.out / "training"
    todo, start = [], 0
    for split, n, pool in zip(SPLITS, counts, pools, strict=True):
        if n:
            names = [f"{start + k:06d}" for k in range(n)]
            write_split(config.out / "ImageSets" / f"{split}.txt", names)
        for k in range(n):
            label = folder / "label_2" / f"{start + k:06d}.txt"
            if config.overwrite or not label.exists():
                todo.append((start + k, k, pool))
        start += n
    calibration = nominal_calibration(sensor_config.scale)
    total: dict[str, int] = {}
    clock = time.process_time()
    with progress() as bar:
        task = bar.add_task("simulate", total=len(todo), status="")
        frames = simulate_frames(
            scene_config, sensor_config, todo, seed=config.seed, batch_size=config.batch_size
        )
        for frame in frames:
            for name, n in write_frame(folder, frame, calibration).items():
                total[name] = total.get(name, 0) + n
            status = f"{total['cars']} cars"
            bar.update(task, advance=1, status=status)
    seconds = time.process_time() - clock
    new = len(todo)
    record = {
        "frames": sum(counts),
        "new_frames": new,
        **total,
        "points_per_frame": total.get("points", 0) / max(new, 1),
        "cpu_seconds": seconds,
        "cpu_seconds_per_frame": seconds / max(new, 1),
        "image_scale": sensor_config.scale,
        # The benchmark's 40, 25 and 25 pixels, for images of this size.
        "min_height": [h * sensor_config.scale for h in (40.0, 25.0, 25.0)],
    }
    if new:
        write_json(config.out / "simulation.json", record)
    if config.picture:
        from fusion.detection.kitti.files import read_frame
        from fusion.detection.simulator.plots import plot_frames

        shown = [
            read_frame(config.out, f"{i:06d}", any_size=True) for i in range(min(4, config.frames))
        ]
        config.picture.parent.mkdir(parents=True, exist_ok=True)
        plot_frames(shown).savefig(config.picture, dpi=110)
    return record


def _fields(done: dict[str, Any]) -> dict[str, Any]:
    shown = ("frames", "new_frames", "objects", "cars", "look_alikes")
    return {k: done[k] for k in shown if k in done} | {
        "points_per_frame": done["points_per_frame"],
        "cpu_seconds_per_frame": done["cpu_seconds_per_frame"],
    }


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
