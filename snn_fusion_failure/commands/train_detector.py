"""Prepare KITTI frames, train AVOD or AVOD-ARGate on them, and evaluate the detections.

    python scripts/train_detector.py prepare --data ROOT --size small
    python scripts/train_detector.py train --data ROOT --model avod_argate --size small --failures
    python scripts/train_detector.py eval --data ROOT --model avod_argate --size small \
        --failures --failure camera_blackout
    python scripts/train_detector.py drive --data ROOT --model dense_argate --size small \
        --failures --failure camera_fog
    python scripts/train_detector.py robustness --data ROOT --model avod_argate --size small \
        --failures
    python scripts/train_detector.py export --data ROOT --model dense_argate --size small --failures

ROOT is a folder in the layout of KITTI (`training/{image_2,velodyne,calib,label_2,planes}`,
`ImageSets/{train,val}.txt`), real or from `scripts/simulate_kitti.py`. `prepare` checks them, fits
missing ground planes, clusters the anchor sizes and writes examples of fixed size; `train`
writes checkpoints, can `--resume`, and ends with `calibrate`, which fits the told probabilities of
failure, and when to call one, to the validation frames; `eval` writes result files in KITTI's
format, precision curves, pictures from above and of the image, and ends with a line `result: ...`.
`--split testing` takes the frames of ROOT/testing (no labels, hence result files and no score).
`robustness` repeats `eval` for every failure at severities 1 to 5 and for corrupted copies of the
frames (`--corrupted`), and prints a table with the mean relative precision (mRA). `drive` simulates
a drive on which a sensor dies and draws what it reads, what is found and what the gate says.
`export` writes the trained detector, resizing and maps included, as a StableHLO program that jax
runs without this package. `small` is for two CPU cores (minutes), `paper` for an accelerator (see
docs/kitti.md).
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from snn_fusion_failure.commands.detector_calibration import FILE, calibrate, calibrate_if_possible
from snn_fusion_failure.commands.detector_drive import drive
from snn_fusion_failure.commands.detector_evaluation import evaluate
from snn_fusion_failure.commands.detector_export import export
from snn_fusion_failure.commands.detector_options import (
    Calibrate,
    Drive,
    Eval,
    Export,
    Prepare,
    Robustness,
    Train,
)
from snn_fusion_failure.commands.detector_preparation import prepare
from snn_fusion_failure.commands.detector_robustness import robustness
from snn_fusion_failure.commands.detector_runs import (
    NOT_SETTINGS,
    build,
    cache_folder,
    resolved,
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


def train(config: Train) -> dict[str, Any]:
    """Train; returns the last row of means."""
    enable_compilation_cache()
    from fusion.detection.learning.cache import TESTING, open_cache, read_example
    from fusion.detection.learning.fitting import fit_detector
    from fusion.detection.learning.sharding import frame_mesh
    from fusion.detection.network.build import count_main_parameters
    from fusion.detection.plots import plot_training

    if config.split == TESTING:
        raise ValueError("split 'testing' has no labels to train on, expected a list of ImageSets")
    cache = open_cache(cache_folder(config))
    setup = build(config, cache)
    frame_mesh(config.devices, setup.train.batch_size)  # before a folder is claimed
    names = cache.names(config.split)
    out = config.out or run_folder(config)
    chosen = {k: v for k, v in dataclasses.asdict(config).items() if k not in NOT_SETTINGS}
    open_run(out, chosen, resume=config.resume, overwrite=config.overwrite)
    checkpoints = out / "checkpoints"
    if config.overwrite and checkpoints.exists():
        shutil.rmtree(checkpoints)
    for stale in (*out.glob("clean_weights_*.npy"), *out.glob(FILE)):
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
        task = bar.add_task(f"train {config.model}", total=setup.train.steps, status="")

        def show(step: int, row: dict[str, float]) -> None:
            status = f"loss {row['total']:.3f} camera weight {row['weight_camera']:.2f}"
            bar.update(task, completed=step, status=status)
            append_metrics(out, row)

        fitted = fit_detector(
            setup.config,
            setup.train,
            setup.params,
            len(names),
            read,
            seed=config.seed,
            on_report=show,
            checkpoint_dir=checkpoints, checkpoint_every=config.checkpoint_every,
            resume=config.resume,
            devices=config.devices,
        )  # fmt: skip
    plot_training(fitted.history).savefig(out / "training.png", dpi=120)
    first, last = fitted.history[0], fitted.history[-1]
    result = {
        "model": config.model,
        "frames": len(names),
        "steps": int(fitted.state.step),
        "parameters": count_main_parameters(setup.config),
        "first_loss": first["total"],
        "loss": last["total"],
        "weight_camera": last["weight_camera"],
    }
    extra = {"settings": resolved(setup), "provenance": provenance()}
    write_json(out / "result.json", result | extra)
    calibrate_if_possible(out, setup, fitted.state, cache)
    return result


def main(
    config: Prepare | Train | Calibrate | Eval | Drive | Export | Robustness,
) -> dict[str, Any]:
    """Run one of the seven commands."""
    run: dict[type, Any] = {
        Prepare: prepare, Train: train, Calibrate: calibrate, Drive: drive, Export: export,
        Robustness: robustness,
    }  # fmt: skip
    if not isinstance(config, Eval):
        shown = result = run[type(config)](config)
    else:
        result = evaluate(config)
        names = (
            "model", "split", "frames", "failure", "3d_moderate_r40", "bev_moderate_r40",
            "3d_moderate_r40_iou50", "3d_moderate_r11", "cap_moderate_r40", "detections",
            "weight_camera", "failed_camera", "failed_lidar", "called_camera", "called_lidar",
            "weight_auroc", "seconds_per_frame",
        )  # fmt: skip
        shown = {k: result[k] for k in names if result.get(k) is not None}
    print_result(**shown)
    return result


Command = (
    Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Drive, tyro.conf.subcommand("drive")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Robustness, tyro.conf.subcommand("robustness")]
)


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Command, main, description=__doc__, argv=argv, prog=prog)
