"""Prepare KITTI frames, train AVOD or AVOD-ARGate on them, and evaluate the detections.

    python scripts/train_detector.py prepare --data ROOT --preset small
    python scripts/train_detector.py train --data ROOT --config avod_argate --preset small \
        --failures
    python scripts/train_detector.py eval --data ROOT --config avod_argate --preset small \
        --failures --failure camera_blackout

ROOT is a folder in the layout of KITTI (`training/{image_2,velodyne,calib,label_2,planes}`,
`ImageSets/{train,val}.txt`), real or from `scripts/simulate_kitti.py`. `prepare` checks them, fits
missing ground planes, clusters the anchor sizes and writes examples of fixed size; `train`
writes checkpoints and can `--resume`; `eval` writes result files in KITTI's format, precision
curves, pictures from above and of the image, and ends with a line `result: ...`. `--split testing`
takes the frames of ROOT/testing (no labels, hence result files and no score). `small` is for two
CPU cores (minutes), `paper` for an accelerator (see docs/kitti.md).
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from snn_fusion_failure.commands.detector_runs import (
    NOT_SETTINGS,
    Eval,
    Prepare,
    Train,
    build,
    cache_folder,
    check_settings,
    load_run,
    resolved,
    run_config,
    run_folder,
)
from snn_fusion_failure.runs import (
    append_metrics,
    enable_compilation_cache,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
)
from snn_fusion_failure.runs.command import run_command


def prepare(config: Prepare) -> dict[str, Any]:
    """Write the cache; returns its counts."""
    from fusion.detection.learning.cache import TESTING, prepare_cache

    with progress() as bar:
        task = bar.add_task("prepare", total=None, status="")
        cache = prepare_cache(
            config.data,
            cache_folder(config),
            config.preset,
            splits=config.splits,
            add=config.add or config.splits[:1] == (TESTING,),
            any_size=config.any_size,
            skip_bad=config.skip_bad,
            on_frame=lambda done, n, name: bar.update(task, total=n, completed=done, status=name),
        )
    for name, reason in cache.counts["skipped"].items():
        print(f"skipped {name}: {reason}")
    if cache.counts["missing"]:
        print(f"{cache.counts['missing']} listed frames have no image and were left out")
    sizes = "; ".join(f"{a:.2f} x {b:.2f} x {c:.2f}" for a, b, c in cache.sizes)
    print(f"anchor sizes (length x width x height) [m]: {sizes}")
    fields = {f"frames_{split}": len(names) for split, names in cache.splits.items()}
    skipped = len(cache.counts["skipped"])
    numbers = {k: v for k, v in cache.counts.items() if k != "skipped"}
    return fields | {"skipped": skipped} | numbers


def train(config: Train) -> dict[str, Any]:
    """Train; returns the last row of means."""
    enable_compilation_cache()
    from fusion.detection.learning.cache import TESTING, open_cache, read_example
    from fusion.detection.learning.fitting import fit_detector
    from fusion.detection.network.detector import count_main_parameters
    from fusion.detection.plots import plot_training

    if config.split == TESTING:
        raise ValueError("split 'testing' has no labels to train on, expected a list of ImageSets")
    cache = open_cache(cache_folder(config))
    detector, training = build(config, cache)
    names = cache.names(config.split)
    out = config.out or run_folder(config)
    chosen = {k: v for k, v in dataclasses.asdict(config).items() if k not in NOT_SETTINGS}
    open_run(out, chosen, resume=config.resume, overwrite=config.overwrite)
    checkpoints = out / "checkpoints"
    if config.overwrite and checkpoints.exists():
        shutil.rmtree(checkpoints)
    for stale in out.glob("clean_weights_*.npy"):
        stale.unlink()
    held: dict[int, Any] = {}

    def read(i: int) -> Any:
        # Small caches stay in memory; full frames of 7,481 would take gigabytes.
        if i not in held:
            example = read_example(cache.folder, names[i])
            if len(names) * sum(a.nbytes for a in example) > 4e9:
                return example
            held[i] = example
        return held[i]

    with progress() as bar:
        task = bar.add_task(f"train {config.config}", total=training.steps, status="")

        def show(step: int, row: dict[str, float]) -> None:
            status = f"loss {row['total']:.3f} camera weight {row['weight_camera']:.2f}"
            bar.update(task, completed=step, status=status)
            append_metrics(out, row)

        fitted = fit_detector(
            config.seed,
            detector,
            training,
            len(names),
            read,
            on_report=show,
            checkpoint_dir=checkpoints,
            checkpoint_every=config.checkpoint_every,
            resume=config.resume,
        )
    if fitted.history:
        plot_training(fitted.history).savefig(out / "training.png", dpi=120)
    first, last = fitted.history[0], fitted.history[-1]
    result = {
        "config": config.config,
        "frames": len(names),
        "steps": int(fitted.state.step),
        "parameters": count_main_parameters(detector),
        "first_loss": first["total"],
        "loss": last["total"],
        "weight_camera": last["weight_camera"],
    }
    extra = {"settings": resolved(detector, training), "provenance": provenance()}
    write_json(out / "result.json", result | extra)
    return result


def evaluate(config: Eval) -> dict[str, Any]:
    """Detect, write result files and pictures, score; returns what `result.json` holds."""
    enable_compilation_cache()
    import numpy as np

    from fusion.detection.kitti.files import read_frame, write_results
    from fusion.detection.learning.cache import TESTING, frame_part, open_cache
    from fusion.detection.learning.fitting import run_detector
    from fusion.detection.learning.scoring import frame_objects, weight_auroc
    from fusion.detection.learning.training import SENSOR_FAILURES
    from fusion.detection.plots import plot_bird, plot_image

    if config.failure is not None and config.failure not in SENSOR_FAILURES:
        raise ValueError(
            f"failure {config.failure!r}, expected one of {', '.join(SENSOR_FAILURES)}"
        )
    folder = config.run or run_folder(config)
    cache = open_cache(cache_folder(config))
    trained = run_config(folder, config)
    config = dataclasses.replace(config, config=trained.config)
    detector, training = build(trained, cache)
    check_settings(folder, detector, training)
    state = load_run(folder, detector, training)
    names, examples = cache.names(config.split), cache.read(config.split)
    failing = f"_{config.failure}" if config.failure else ""
    out = config.out or folder / f"eval_{config.split}{failing}"
    clock: list[float] = []
    with progress() as bar:
        task = bar.add_task(f"detect {config.failure or ''}", total=len(names), status="")

        def show(done: int) -> None:
            clock.append(time.perf_counter())
            bar.update(task, completed=done)

        found = run_detector(
            state,
            detector,
            examples,
            failure=config.failure,
            severity=config.severity,
            seed=config.seed,
            on_frame=show,
        )
    objects = frame_objects(found, examples)
    for name, detections in zip(names, objects, strict=True):
        write_results(out / "data" / f"{name}.txt", detections)
    weights = np.stack([d.weights for d in found])
    summary: dict[str, Any] = {
        "config": config.config,
        "split": config.split,
        "frames": len(names),
        "failure": config.failure,
        "detections": sum(len(o) for o in objects),
        "weight_camera": float(weights[:, 0].mean()),
        # The first frame waits for the compiler.
        "seconds_per_frame": (clock[-1] - clock[0]) / (len(clock) - 1) if clock[1:] else None,
    }
    if config.split != TESTING:
        widths = [float(example.image_size[1]) for example in examples]
        summary |= _score(config, names, objects, widths, out)
    if config.failure and config.config == "avod_argate":
        path = _clean_weights(folder, config)
        if not path.exists():
            clean = run_detector(state, detector, examples, seed=config.seed)
            np.save(path, np.stack([d.weights for d in clean]))
        sensor = 0 if config.failure.startswith("camera") else 1
        summary["weight_auroc"] = weight_auroc(np.load(path), weights, sensor)
    elif not config.failure:
        np.save(_clean_weights(folder, config), weights)
    # Where nothing failed the picture shows the frame as it is; a failed sensor's is not drawn.
    for i in range(min(config.pictures, len(names))):
        frame = read_frame(config.data, names[i], part=frame_part(config.split), any_size=True)
        best = _drawn(objects[i])
        plot_bird(frame, best).savefig(out / f"{names[i]}_bird.png", dpi=120)
        plot_image(frame, best).savefig(out / f"{names[i]}_image.png", dpi=120)
    np.savetxt(out / "fusion_weights.txt", weights, fmt="%.6f", header="camera lidar")
    write_json(out / "result.json", summary | {"provenance": provenance()})
    print(f"{len(names)} frames, result files and pictures in {out}")
    return summary


def _score(
    config: Eval, names: tuple[str, ...], objects: list[Any], widths: list[float], out: Path
) -> dict[str, Any]:
    """Average precisions at both overlaps, and the curves as a picture."""
    from fusion.detection.kitti.average_precision import average_precision_cap
    from fusion.detection.kitti.files import read_labels
    from fusion.detection.learning.scoring import car_precision, precision_fields
    from fusion.detection.plots import plot_precision

    folder = config.data / "training" / "label_2"
    labels = [read_labels(folder / f"{name}.txt") for name in names]
    scored = car_precision(labels, objects, widths, min_overlap=config.overlap)
    loose = car_precision(labels, objects, widths, min_overlap=config.loose_overlap)
    plot_precision({config.config: scored}).savefig(out / "precision.png", dpi=120)
    # The benchmark's looser variant counts boxes on the ground and in 3D; images stay at 0.7.
    suffix = f"_iou{100 * config.loose_overlap:.0f}"
    return {
        "cars": scored.n_objects[0],
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
    return folder / f"clean_weights_{config.split}.npy"


def _drawn(objects: Any, threshold: float = 0.3) -> Any:
    import numpy as np

    from fusion.detection.kitti.objects import select

    return select(objects, np.flatnonzero(objects.score >= threshold))


def main(config: Prepare | Train | Eval) -> dict[str, Any]:
    """Run one of the three commands."""
    if isinstance(config, Prepare):
        result = prepare(config)
        shown = result
    elif isinstance(config, Train):
        result = train(config)
        shown = result
    else:
        result = evaluate(config)
        names = (
            "config", "split", "frames", "failure", "3d_moderate_r40", "bev_moderate_r40",
            "3d_moderate_r40_iou50", "3d_moderate_r11", "cap_moderate_r40", "detections",
            "weight_camera", "weight_auroc", "seconds_per_frame",
        )  # fmt: skip
        shown = {k: result[k] for k in names if result.get(k) is not None}
    print_result(**shown)
    return result


Command = (
    Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
)


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Command, main, description=__doc__, argv=argv, prog=prog)
