"""`train_detector.py prepare`: frames checked once and written as examples of fixed size."""

from __future__ import annotations

from typing import Any

from snn_fusion_failure.commands.detector_options import Prepare
from snn_fusion_failure.commands.detector_runs import cache_folder
from snn_fusion_failure.runs import progress


def prepare(config: Prepare) -> dict[str, Any]:
    """Write the cache; returns its counts."""
    from fusion.detection.geometry.planes import PlaneConfig
    from fusion.detection.learning.cache import TESTING, open_cache, prepare_cache

    if config.beams is not None and config.beam_elevations:
        raise ValueError(
            f"beams={config.beams}: expected none beside --beam-elevations, which are "
            f"{len(config.beam_elevations)}; leave one out"
        )
    with progress() as bar:
        task = bar.add_task("prepare", total=None, status="")
        cache = prepare_cache(
            config.data,
            cache_folder(config),
            config.size,
            splits=config.splits,
            add=config.add or config.splits[:1] == (TESTING,),
            like=open_cache(config.like) if config.like else None,
            copies=config.copies,
            any_size=config.any_size,
            target=config.target,
            skip_bad=config.skip_bad,
            ground=PlaneConfig(camera_height=config.camera_height, max_tilt=config.camera_tilt),
            beams=config.beam_elevations or config.beams,
            on_frame=lambda done, n, name: bar.update(task, total=n, completed=done, status=name),
        )
    for name, reason in cache.counts["skipped"].items():
        print(f"skipped {name}: {reason}")
    if cache.counts["missing"]:
        print(f"{cache.counts['missing']} listed frames have no image and were left out")
    sizes = "; ".join(f"{a:.2f} x {b:.2f} x {c:.2f}" for a, b, c in cache.sizes)
    print(f"anchor sizes (length x width x height) [m]: {sizes}")
    if cache.beams:
        print(f"{len(cache.beams)} beams from {cache.beams[0]:g} to {cache.beams[-1]:g} degrees")
    elif cache.beams is not None:
        print(
            "the scans do not show the lidar's beams: lidar_beam_loss needs --beams or "
            "--beam-elevations"
        )
    fields = {f"frames_{split}": len(names) for split, names in cache.splits.items()}
    return fields | {"skipped": 0} | cache.counts | {"skipped": len(cache.counts["skipped"])}
