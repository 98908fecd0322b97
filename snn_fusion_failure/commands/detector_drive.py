"""`train_detector.py drive`: a picture of a drive on which a sensor dies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_calibration import read_calibration
from snn_fusion_failure.commands.detector_options import Drive
from snn_fusion_failure.commands.detector_runs import (
    build,
    cache_folder,
    load_run,
    run_config,
    run_folder,
)
from snn_fusion_failure.runs import enable_compilation_cache, progress


def severities(n: int) -> list[float]:
    """Of the failure in each frame: 0 in the first third, rising in the second, 1 in the last.

    Example:
        >>> severities(7)
        [0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0]
    """
    return [min(1.0, max(0.0, 3.0 * i / max(1, n - 1) - 1.0)) for i in range(n)]


def drive(config: Drive) -> dict[str, Any]:
    """Simulate the drive, detect in every frame, write the picture; returns means."""
    run = config.run or run_folder(config)
    out = config.out or run / f"drive_{config.failure}.gif"
    if out.suffix not in (".gif", ".png"):
        raise ValueError(f"out={out}: expected a .gif, which moves, or a .png; rename it")
    enable_compilation_cache()
    import numpy as np

    from fusion.detection.drive_plots import Moment
    from fusion.detection.learning.cache import open_cache
    from fusion.detection.learning.examples import MEAN_RGB, make_example
    from fusion.detection.learning.fitting import failed_inputs, run_detector
    from fusion.detection.learning.training import FAILURES
    from fusion.detection.simulator.drive import drive_frames
    from fusion.detection.simulator.frames import kitti_frame
    from fusion.detection.simulator.rendering import SIZES, nominal_calibration
    from fusion.detection.simulator.scene import SceneConfig

    if config.failure not in FAILURES:
        raise ValueError(f"failure={config.failure!r}: expected one of {', '.join(FAILURES)}")
    trained = run_config(run, config)
    setup = build(trained, open_cache(cache_folder(config)))
    state = load_run(run, setup)
    told = read_calibration(run, state)
    sensors = SIZES[config.size]
    calibration = nominal_calibration(sensors.scale)
    moments = []
    with progress() as bar:
        task = bar.add_task("drive", total=config.frames, status="")
        made = drive_frames(
            SceneConfig(night=0.0), sensors, config.frames, seed=config.scene, speed=config.speed
        )
        for simulated, severity in zip(made, severities(config.frames), strict=True):
            example, _ = make_example(setup.config, kitti_frame(simulated, calibration))
            # The same noise in every frame: only the severity changes.
            options: dict[str, Any] = {
                "failure": config.failure,
                "severity": severity,
                "seed": config.seed,
            }
            inputs = failed_inputs(setup.config, example, **options)
            (found,) = run_detector(setup.config, state, [example], calibration=told, **options)
            sure = found.mask & (found.scores >= config.threshold)
            moments.append(
                Moment(
                    image=np.clip(np.asarray(inputs.image[0]) + np.asarray(MEAN_RGB), 0, 1),
                    map=np.asarray(inputs.bev[0, ..., -1]),
                    labels=np.asarray(example.truth)[np.asarray(example.truth_mask)],
                    found=np.asarray(found.boxes)[np.asarray(sure)],
                    weights=np.asarray(found.weights),
                    failed=np.asarray(found.failed),
                    severity=severity,
                )
            )
            bar.update(task, advance=1)
    threshold = None if told is None else np.asarray(told.threshold)
    _save(out, config, moments, setup.config.bev, threshold)
    sensor = "lidar" if config.failure.startswith("lidar") else "camera"
    k = ("camera", "lidar").index(sensor)
    return {
        "picture": str(out),
        "frames": len(moments),
        f"weight_{sensor}_first": float(moments[0].weights[k]),
        f"weight_{sensor}_last": float(moments[-1].weights[k]),
        f"failed_{sensor}_first": float(moments[0].failed[k]),
        f"failed_{sensor}_last": float(moments[-1].failed[k]),
        "detections": sum(len(m.found) for m in moments),
        "kilobytes": out.stat().st_size / 1e3,
    }


def _save(out: Path, config: Drive, moments: list[Any], area: Any, threshold: Any) -> None:
    """Write the drive as a moving picture or as some of its moments."""
    from fusion.detection.drive_plots import plot_drive, plot_moments

    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".gif":
        moving = plot_drive(moments, area, config.failure, threshold)
        moving.save(out, writer="pillow", fps=config.fps, dpi=config.dpi)
        return
    # No palette: it would merge the few green pixels of the labels into another colour.
    plot_moments(moments, area, config.failure, threshold).savefig(out, dpi=config.dpi)
