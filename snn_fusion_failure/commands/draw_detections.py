"""Draw result files of the detector: images with boxes, and the road from above.

    python scripts/draw_detections.py --data SIM --found RUN/eval_test_clean/data --out FILE.png

Takes the first frames that have a result file and enough labelled cars (`--min-cars`), so that
nobody chooses which frames are shown. Seconds. Last line: `result: frames=... detections=...`.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw detections beside labels."""

    data: Path
    """KITTI folder of the frames, with labels."""
    found: Path
    """Folder of result files, 000000.txt and so on."""
    out: Path
    """Picture to write."""
    frames: int = 3
    min_cars: int = 2
    """Labelled cars that a frame must have."""
    threshold: float = 0.3
    """Least score of a detection that is drawn."""
    dpi: int = 70


def main(config: Config) -> dict[str, Any]:
    """Draw the picture; returns what was drawn."""
    import numpy as np
    from PIL import Image

    from fusion.detection.kitti.files import frame_names, read_frame, read_labels, read_results
    from fusion.detection.kitti.objects import select
    from fusion.detection.plots import plot_detections

    chosen = []
    for name in frame_names(config.found):
        labels = read_labels(config.data / "training" / "label_2" / f"{name}.txt")
        if (labels.type == "Car").sum() >= config.min_cars:
            chosen.append(name)
        if len(chosen) == config.frames:
            break
    if not chosen:
        raise ValueError(
            f"{config.found}: no frame with a result file has {config.min_cars} labelled cars"
        )
    frames = [read_frame(config.data, name, any_size=True) for name in chosen]
    found = [read_results(config.found / f"{name}.txt") for name in chosen]
    found = [select(o, np.flatnonzero(o.score >= config.threshold)) for o in found]
    config.out.parent.mkdir(parents=True, exist_ok=True)
    drawing = io.BytesIO()
    plot_detections(frames, found).savefig(drawing, dpi=config.dpi)
    with Image.open(drawing) as picture:
        # A palette makes the file a third as large.
        picture.convert("RGB").quantize(128).save(config.out, optimize=True)
    return {"frames": chosen, "detections": sum(len(o) for o in found)}


def _fields(drawn: dict[str, Any]) -> dict[str, Any]:
    return {"frames": ",".join(drawn["frames"]), "detections": drawn["detections"]}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
