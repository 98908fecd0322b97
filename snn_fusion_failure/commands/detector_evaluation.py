"""`train_detector.py eval`: detections of a trained run, scored and drawn."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_calibration import read_calibration
from snn_fusion_failure.commands.detector_options import Eval
from snn_fusion_failure.commands.detector_runs import (
    build,
    cache_folder,
    check_settings,
    load_run,
    run_config,
    run_folder,
)
from snn_fusion_failure.runs import enable_compilation_cache, progress, provenance, write_json


def evaluate(config: Eval) -> dict[str, Any]:
    """Detect, write result files and pictures, score; returns what `result.json` holds."""
    enable_compilation_cache()
    import numpy as np

    from fusion.detection.kitti.files import read_frame, write_results
    from fusion.detection.learning.cache import TESTING, frame_part, open_cache, read_example
    from fusion.detection.learning.examples import Example
    from fusion.detection.learning.fitting import run_detector
    from fusion.detection.learning.scoring import Camera, frame_objects, weight_auroc
    from fusion.detection.learning.training import FAILURES
    from fusion.detection.network.detector import SENSORS
    from fusion.detection.plots import plot_bird, plot_image

    if config.failure is not None and config.failure not in FAILURES:
        raise ValueError(f"failure={config.failure!r}: expected one of {', '.join(FAILURES)}")
    folder = config.run or run_folder(config)
    cache = open_cache(cache_folder(config))
    trained = run_config(folder, config)
    config = dataclasses.replace(config, model=trained.model)
    setup = build(trained, cache)
    check_settings(folder, setup)
    state = load_run(folder, setup)
    calibration = read_calibration(folder, state)
    names = cache.names(config.split)
    cameras: dict[str, Camera] = {}

    def examples() -> Iterator[Example]:
        # One frame in memory at a time: the validation list at `paper` is 7 GB.
        for name in names:
            example = read_example(cache.examples(config.split), name)
            cameras[name] = Camera(np.asarray(example.p2), np.asarray(example.image_size))
            yield example

    failing = f"_{config.failure}" if config.failure else ""
    out = config.out or folder / f"eval_{config.split}{failing}"
    clock: list[float] = []
    with progress() as bar:
        task = bar.add_task(f"detect {config.failure or ''}", total=len(names), status="")

        def show(done: int) -> None:
            clock.append(time.perf_counter())
            bar.update(task, completed=done)

        found = run_detector(
            setup.config,
            state,
            examples(),
            failure=config.failure,
            severity=config.severity,
            seed=config.seed,
            calibration=calibration,
            on_frame=show,
        )
    target = setup.config.target
    objects = frame_objects(found, list(cameras.values()), target)
    for name, detections in zip(names, objects, strict=True):
        write_results(out / "data" / f"{name}.txt", detections)
    weights = np.stack([d.weights for d in found])
    failed = np.stack([d.failed for d in found])
    summary: dict[str, Any] = {
        "model": config.model,
        "split": config.split,
        "frames": len(names),
        "failure": config.failure,
        "detections": sum(len(o) for o in objects),
        "weight_camera": float(weights[:, 0].mean()),
        # Mean probabilities, where the gate tells any.
        "failed_camera": float(failed[:, 0].mean()) if np.isfinite(failed).all() else None,
        "failed_lidar": float(failed[:, 1].mean()) if np.isfinite(failed).all() else None,
        # The first frame waits for the compiler.
        "seconds_per_frame": (clock[-1] - clock[0]) / (len(clock) - 1) if clock[1:] else None,
    }
    if calibration is not None:
        called = (failed > np.asarray(calibration.threshold)[None]).mean(axis=0)
        summary |= {
            f"called_{sensor}": float(share) for sensor, share in zip(SENSORS, called, strict=True)
        }
    if config.split != TESTING:
        widths = [float(camera.image_size[1]) for camera in cameras.values()]
        summary |= _score(config, target, names, objects, widths, out)
    if config.failure and config.failure.startswith(SENSORS) and setup.config.weighs:
        path = _clean_weights(folder, config)
        if not path.exists():
            clean = run_detector(setup.config, state, examples(), seed=config.seed)
            np.save(path, np.stack([d.weights for d in clean]))
        sensor = 0 if config.failure.startswith("camera") else 1
        summary["weight_auroc"] = weight_auroc(np.load(path), weights, sensor)
    elif not config.failure:
        np.save(_clean_weights(folder, config), weights)
    # Where nothing failed the picture shows the frame as it is; a failed sensor's is not drawn.
    for i in range(min(config.pictures, len(names))):
        frame = read_frame(
            config.data, names[i], part=frame_part(config.split), any_size=True, may_be_dead=True
        )
        best = _drawn(objects[i])
        plot_bird(frame, best).savefig(out / f"{names[i]}_bird.png", dpi=120)
        plot_image(frame, best).savefig(out / f"{names[i]}_image.png", dpi=120)
    np.savetxt(out / "fusion_weights.txt", weights, fmt="%.6f", header="camera lidar")
    if np.isfinite(failed).all():
        np.savetxt(out / "failed.txt", failed, fmt="%.9g", header="camera lidar")
    write_json(out / "result.json", summary | {"provenance": provenance()})
    print(f"{len(names)} frames, result files and pictures in {out}")
    return summary


def _score(
    config: Eval,
    target: str,
    names: tuple[str, ...],
    objects: list[Any],
    widths: list[float],
    out: Path,
) -> dict[str, Any]:
    """Average precisions at both overlaps, and the curves as a picture."""
    from fusion.detection.kitti.average_precision import average_precision_cap
    from fusion.detection.kitti.files import read_labels
    from fusion.detection.learning.scoring import class_precision, precision_fields
    from fusion.detection.plots import plot_precision

    folder = config.data / "training" / "label_2"
    labels = [read_labels(folder / f"{name}.txt") for name in names]
    loose_overlap = config.loose_overlap or (0.5 if target == "Car" else 0.25)
    scored, loose = (
        class_precision(labels, objects, widths, target=target, min_overlap=overlap)
        for overlap in (config.overlap, loose_overlap)
    )
    plot_precision({config.model: scored}).savefig(out / "precision.png", dpi=120)
    # The benchmark's looser variant counts boxes on the ground and in 3D; images stay at 0.7.
    suffix = f"_iou{100 * loose_overlap:.0f}"
    return {
        "objects" if target != "Car" else "cars": scored.n_objects[0],
        "cap_moderate_r40": average_precision_cap(int(scored.n_objects[0, 1]), 40),
        **precision_fields(scored),
        **{
            name + suffix: value
            for name, value in precision_fields(loose).items()
            if name.startswith(("bev", "3d"))
        },
    }


def _clean_weights(folder: Path, config: Eval) -> Path:
    """Where the fusion weights of frames without failure are kept, to compare with."""
    return folder / f"clean_weights_{config.data.resolve().name}_{config.split}.npy"


def _drawn(objects: Any, threshold: float = 0.3) -> Any:
    import numpy as np

    from fusion.detection.kitti.objects import select

    return select(objects, np.flatnonzero(objects.score >= threshold))
