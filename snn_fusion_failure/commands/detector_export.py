"""`train_detector.py export`: a trained run as a program for processes without this package."""

from __future__ import annotations

from typing import Any

from snn_fusion_failure.commands.detector_calibration import read_calibration
from snn_fusion_failure.commands.detector_options import Export
from snn_fusion_failure.commands.detector_runs import (
    build,
    cache_folder,
    check_settings,
    load_run,
    run_config,
    run_folder,
)


def export(config: Export) -> dict[str, Any]:
    """Write the program; returns what its callers have to know."""
    import numpy as np

    from fusion.detection.learning.cache import open_cache, read_example
    from fusion.detection.learning.stablehlo import write_detector
    from fusion.detection.network.detector import SENSORS

    run = config.run or run_folder(config)
    cache = open_cache(cache_folder(config))
    trained = run_config(run, config)
    setup = build(trained, cache)
    check_settings(run, setup)
    size = config.image_size
    if size is None:
        # Frames of one camera have one size, but for the benchmark's own by a few pixels.
        first = read_example(cache.examples(trained.split), cache.names(trained.split)[0])
        rows, columns = np.asarray(first.image_size).astype(int).tolist()
        size = (rows, columns)
    out = config.out or run / "detector.stablehlo"
    state = load_run(run, setup)
    calibration = read_calibration(run, state)
    write_detector(
        setup.config,
        state,
        out,
        image_size=size,
        n_points=config.points,
        platforms=config.platforms,
        calibration=calibration,
    )
    # The program tells probabilities; from which one on to call a failure is its caller's to know.
    calls = {} if calibration is None else dict(zip(SENSORS, calibration.threshold, strict=True))
    return {
        "program": str(out),
        "model": trained.model,
        "rows": size[0],
        "columns": size[1],
        "points": config.points,
        "megabytes": out.stat().st_size / 1e6,
        **{f"threshold_{sensor}": value for sensor, value in calls.items()},
    }
