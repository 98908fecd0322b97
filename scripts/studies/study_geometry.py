"""Do lidar, camera and labels fit together, on real and on simulated frames?

    python scripts/studies/study_geometry.py --real KITTI --simulated SIM

KITTI and SIM are folders in the layout of KITTI (SIM by `scripts/simulate_kitti.py`). Prints a
table and writes `results/study_kitti_geometry.json`: lidar points of labelled cars and their image
boxes, projected boxes against labelled ones, transforms there and back, fitted ground planes
against given ones. A second a frame of the benchmark's size.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from snn_fusion_failure.records.rows import record_table
from snn_fusion_failure.runs import fail, print_result, progress, repository

TITLE = "Lidar, camera and labels of KITTI frames (real) and of simulated ones"


@dataclasses.dataclass(frozen=True)
class Config:
    """Folders to check."""

    real: Path | None = None
    """KITTI folder; every labelled frame with an image is checked."""
    simulated: Path | None = None
    """Folder of simulated frames."""
    frames: int = 100
    """At most so many frames of each folder, the first ones."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's in `--real` as well."""
    results: Path = repository.RESULTS


def measure(folder: Path, frames: int, any_size: bool) -> list[dict[str, Any]]:
    """Rows of one folder: name, unit, mean over what `n` counts."""
    import numpy as np

    from fusion.detection.alignment import align_frame
    from fusion.detection.kitti.files import frame_names, read_frame

    names = frame_names(folder / "training" / "image_2", ".png")[:frames]
    found = []
    with progress() as bar:
        task = bar.add_task(folder.name, total=len(names), status="")
        for name in names:
            found.append(align_frame(read_frame(folder, name, any_size=any_size)))
            bar.update(task, advance=1, status=name)

    def pooled(field: str) -> Any:
        return np.concatenate([getattr(f, field) for f in found])

    planes = np.array([f.plane for f in found if f.plane is not None]).reshape(-1, 2)
    in_box, around, overlap = pooled("in_box"), pooled("around"), pooled("overlap")
    standing = np.abs(pooled("standing"))
    n_hit = int((in_box > 0).sum())
    rows: list[tuple[str, str, float, int]] = [
        ("frames", "", len(names), len(names)),
        ("labelled cars", "", len(in_box), len(names)),
    ]
    if n_hit:
        share = 100.0 * pooled("in_both").sum() / in_box.sum()
        held = 100.0 * pooled("around_in").sum() / max(around.sum(), 1)
        turned = 100.0 * pooled("turned_in").sum() / max(pooled("turned").sum(), 1)
        rows += [
            ("cars with a lidar point in their 3D box", "%", 100.0 * n_hit / len(in_box),
             len(in_box)),
            ("lidar points in a car's 3D box that project into its image box", "%", share, n_hit),
            ("lidar points within 0.5 m of a car's sides that are in its 3D box", "%", held,
             len(in_box)),
            ("the same with the scan turned by 1 degree", "%", turned, len(in_box)),
        ]  # fmt: skip
    if len(overlap):
        rows += [
            ("overlap of projected and labelled box, mean", "1", overlap.mean(), len(overlap)),
            ("overlap of projected and labelled box, least", "1", overlap.min(), len(overlap)),
        ]
    rows += [
        ("error after lidar, camera, lidar, largest", "m", max(f.lidar_error for f in found),
         len(found)),
        ("error after camera, image, camera, largest", "m", max(f.image_error for f in found),
         len(found)),
    ]  # fmt: skip
    if len(planes):
        for column, (kind, unit) in enumerate((("height", "m"), ("tilt", "degree"))):
            values = planes[:, column]
            rows += [
                (f"fitted against given plane, {kind}, mean", unit, values.mean(), len(values)),
                (f"fitted against given plane, {kind}, largest", unit, values.max(), len(values)),
            ]
    if len(standing):
        name = "height of a car's bottom above the fitted plane, mean size"
        rows.append((name, "m", standing.mean(), len(standing)))
    return [{"row": r, "unit": u, "mean": float(v), "n": n} for r, u, v, n in rows]


def main(config: Config) -> dict[str, Any]:
    """Check the folders, print the table, write the record."""
    from snn_fusion_failure.records import markdown

    rows: list[dict[str, Any]] = []
    for model, folder in (("real", config.real), ("simulated", config.simulated)):
        if folder is not None:
            for row in measure(folder, config.frames, config.any_size or model == "simulated"):
                rows.append({"model": model, "metric": "geometry"} | row)
    if not rows:
        raise ValueError("expected --real or --simulated, a folder of frames")
    table = "study_kitti_geometry"
    record_table(config.results / f"{table}.json", table, TITLE, rows, preset="all")
    print(markdown.measured(rows))
    fields = {row["model"]: int(row["mean"]) for row in rows if row["row"] == "frames"}
    print_result(**fields, rows=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        fail(str(error))
