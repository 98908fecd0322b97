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
curves, pictures from above and of the image, and ends with a line `result: ...`. `small` is for two
CPU cores (minutes), `paper` for an accelerator (see docs/kitti.md).
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from scripts import _run

Model = Literal["avod", "avod_argate"]
PresetName = Literal["paper", "small", "tiny"]


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Check the frames of the split lists and write them as examples of fixed size."""

    data: Path
    """KITTI folder."""
    preset: PresetName = "small"
    cache: Path | None = None
    """Where the examples go; DATA/cache_PRESET when left out."""
    splits: tuple[str, ...] = ("train", "val")
    """Lists in ImageSets; the first one gives the anchor sizes."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's (simulated frames)."""
    skip_bad: bool = False
    """Leave out damaged frames, and count them, instead of stopping at the first."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train one detector."""

    data: Path
    config: Model = "avod_argate"
    preset: PresetName = "small"
    cache: Path | None = None
    split: str = "train"
    seed: int = 0
    steps: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    failures: bool = False
    """One sensor fails in two thirds of the training frames."""
    failure_kinds: tuple[str, ...] = ()
    """Only these failures, e.g. camera_noise lidar_loss; all when left out."""
    norm: Literal["batch", "group"] | None = None
    normalizer: Literal["softmax", "softmax_sigmoid"] | None = None
    """Of the fusion weights; softmax_sigmoid is the printed one."""
    alpha: float | None = None
    """Weight of the auxiliary losses (Equation 3.2)."""
    beta: float | None = None
    """Weight of the fusion-weight regularization (Equation 3.2)."""
    tau: float | None = None
    """Temperature of the fixed targets."""
    path_drop: float | None = None
    """Probability to drop a view in training."""
    truth_proposals: int | None = None
    """Shifted copies of each label among the training proposals."""
    checkpoint_every: int = 500
    out: Path | None = None
    """Run folder; runs/detector/DATA_CONFIG_PRESET[_failures]_sSEED when left out."""
    resume: bool = False
    overwrite: bool = False


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluate a trained detector, all sensors working or one failed."""

    data: Path
    config: Model = "avod_argate"
    preset: PresetName = "small"
    cache: Path | None = None
    split: str = "val"
    seed: int = 0
    failures: bool = False
    """The run that was trained with failures (names the folder)."""
    run: Path | None = None
    """Run folder; named as in `train` when left out."""
    failure: str | None = None
    """Sensor failure in every frame, e.g. camera_blackout, lidar_loss."""
    severity: float = 1.0
    overlap: float = 0.7
    """Least overlap of a hit."""
    pictures: int = 2
    """Frames to draw."""
    out: Path | None = None
    """Folder of results; RUN/eval_SPLIT[_FAILURE] when left out."""


# Options that do not change the numbers of a run.
_NOT_SETTINGS = ("out", "resume", "overwrite", "data", "cache", "checkpoint_every")
CLASS = "Car"


def cache_folder(config: Prepare | Train | Eval) -> Path:
    """Where the examples of a data folder and preset are."""
    return config.cache or config.data / f"cache_{config.preset}"


def run_folder(config: Train | Eval) -> Path:
    """Where a training keeps its files."""
    failing = "_failures" if config.failures else ""
    name = f"{config.data.resolve().name}_{config.config}_{config.preset}{failing}_s{config.seed}"
    return Path("runs") / "detector" / name


def prepare(config: Prepare) -> dict[str, Any]:
    """Write the cache; returns its counts."""
    from fusion.detection.cache import prepare_cache

    with _run.progress() as bar:
        task = bar.add_task("prepare", total=None, status="")
        cache = prepare_cache(
            config.data,
            cache_folder(config),
            config.preset,
            splits=config.splits,
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


def build(config: Train, cache: Any) -> tuple[Any, Any]:
    """Detector and training of a command line, for a cache."""
    from fusion.detection.training import training_preset

    if cache.preset != config.preset:
        raise ValueError(
            f"{cache.folder} was prepared for preset {cache.preset!r}, not {config.preset!r}: run "
            "`prepare` with the preset of the training"
        )
    detector = cache.config(config.config)
    given = {k: getattr(config, k) for k in ("norm", "normalizer", "path_drop", "truth_proposals")}
    detector = dataclasses.replace(detector, **{k: v for k, v in given.items() if v is not None})
    weights = {k: v for k in ("alpha", "beta", "tau") if (v := getattr(config, k)) is not None}
    detector = dataclasses.replace(detector, gate_params=detector.gate_params._replace(**weights))
    train = training_preset(config.preset)
    given = {k: getattr(config, k) for k in ("steps", "batch_size", "learning_rate")}
    changes = {k: v for k, v in given.items() if v is not None}
    if config.failures:
        changes["failure_share"] = 2.0 / 3.0
    if config.failure_kinds:
        changes["failure_kinds"] = config.failure_kinds
    return detector, dataclasses.replace(train, **changes)


def train(config: Train) -> dict[str, Any]:
    """Train; returns the last row of means."""
    _run.enable_compilation_cache()
    from fusion.detection.cache import open_cache, read_example
    from fusion.detection.detector import count_main_parameters
    from fusion.detection.fitting import fit_detector
    from fusion.detection.plots import plot_training

    cache = open_cache(cache_folder(config))
    detector, training = build(config, cache)
    names = cache.splits[config.split]
    out = config.out or run_folder(config)
    chosen = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_SETTINGS}
    _run.open_run(out, chosen, resume=config.resume, overwrite=config.overwrite)
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

    with _run.progress() as bar:
        task = bar.add_task(f"train {config.config}", total=training.steps, status="")

        def show(step: int, row: dict[str, float]) -> None:
            status = f"loss {row['total']:.3f} camera weight {row['weight_camera']:.2f}"
            bar.update(task, completed=step, status=status)
            _run.append_metrics(out, row)

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
    _run.write_json(out / "result.json", result | {"provenance": _run.provenance()})
    return result


def load_run(folder: Path, detector: Any, training: Any) -> Any:
    """The newest state of a run folder.

    Raises:
        FileNotFoundError: no training was kept there.
    """
    from fusion.detection.fitting import restore_detector

    state = restore_detector(folder / "checkpoints", detector, training)
    if state is None:
        raise FileNotFoundError(f"{folder} holds no checkpoint: run `train` first")
    return state


def run_config(folder: Path, config: Eval) -> Train:
    """The command line that a run was trained with.

    Raises:
        FileNotFoundError: there is no run.
    """
    import json

    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no run: run `train` first")
    held = json.loads(path.read_text(encoding="utf-8"))["settings"]
    held["failure_kinds"] = tuple(held["failure_kinds"])
    return Train(data=config.data, cache=config.cache, **held)


def evaluate(config: Eval) -> dict[str, Any]:
    """Detect, write result files and pictures, score; returns what `result.json` holds."""
    _run.enable_compilation_cache()
    import numpy as np

    from fusion.detection.cache import open_cache
    from fusion.detection.evaluate import average_precision_cap
    from fusion.detection.fitting import run_detector
    from fusion.detection.io import read_frame, read_labels, write_results
    from fusion.detection.plots import plot_bird, plot_image, plot_precision
    from fusion.detection.scoring import (
        car_precision,
        frame_objects,
        precision_fields,
        weight_auroc,
    )
    from fusion.detection.training import SENSOR_FAILURES

    if config.failure is not None and config.failure not in SENSOR_FAILURES:
        raise ValueError(
            f"failure {config.failure!r}, expected one of {', '.join(SENSOR_FAILURES)}"
        )
    folder = config.run or run_folder(config)
    cache = open_cache(cache_folder(config))
    detector, training = build(run_config(folder, config), cache)
    state = load_run(folder, detector, training)
    names, examples = cache.splits[config.split], cache.read(config.split)
    failing = f"_{config.failure}" if config.failure else ""
    out = config.out or folder / f"eval_{config.split}{failing}"
    with _run.progress() as bar:
        task = bar.add_task(f"detect {config.failure or ''}", total=len(names), status="")
        found = run_detector(
            state,
            detector,
            examples,
            failure=config.failure,
            severity=config.severity,
            seed=config.seed,
            on_frame=lambda i: bar.update(task, completed=i),
        )
    objects = frame_objects(found, examples)
    for name, detections in zip(names, objects, strict=True):
        write_results(out / "data" / f"{name}.txt", detections)
    label_folder = config.data / "training" / "label_2"
    labels = [read_labels(label_folder / f"{name}.txt") for name in names]
    widths = [float(example.image_size[1]) for example in examples]
    scored = car_precision(labels, objects, widths, min_overlap=config.overlap)
    weights = np.stack([d.weights for d in found])
    summary: dict[str, Any] = {
        "config": config.config,
        "split": config.split,
        "frames": len(names),
        "failure": config.failure,
        "cars": scored.n_objects[0],
        "cap_moderate_r40": average_precision_cap(int(scored.n_objects[0, 1]), 40),
        "detections": int(scored.n_detections[0]),
        "weight_camera": float(weights[:, 0].mean()),
        **precision_fields(scored),
    }
    if config.failure and config.config == "avod_argate":
        path = _clean_weights(folder, config)
        if not path.exists():
            clean = run_detector(state, detector, examples, seed=config.seed)
            np.save(path, np.stack([d.weights for d in clean]))
        sensor = 0 if config.failure.startswith("camera") else 1
        summary["weight_auroc"] = weight_auroc(np.load(path), weights, sensor)
    elif not config.failure:
        np.save(_clean_weights(folder, config), weights)
    plot_precision({config.config: scored}).savefig(out / "precision.png", dpi=120)
    # Where nothing failed the picture shows the frame as it is; a failed sensor's is not drawn.
    for i in range(min(config.pictures, len(names))):
        frame = read_frame(config.data, names[i], any_size=True)
        best = _drawn(objects[i])
        plot_bird(frame, best).savefig(out / f"{names[i]}_bird.png", dpi=120)
        plot_image(frame, best).savefig(out / f"{names[i]}_image.png", dpi=120)
    np.savetxt(out / "fusion_weights.txt", weights, fmt="%.6f", header="camera lidar")
    _run.write_json(out / "result.json", summary | {"provenance": _run.provenance()})
    print(f"{len(names)} frames, result files and pictures in {out}")
    return summary


def _clean_weights(folder: Path, config: Eval) -> Path:
    """Where the fusion weights of frames without failure are kept, to compare with."""
    return folder / f"clean_weights_{config.split}.npy"


def _drawn(objects: Any, threshold: float = 0.3) -> Any:
    import numpy as np

    from fusion.detection.objects import select

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
            "3d_moderate_r11", "cap_moderate_r40", "weight_camera", "weight_auroc",
        )  # fmt: skip
        shown = {k: result[k] for k in names if result.get(k) is not None}
    _run.print_result(**shown)
    return result


Command = (
    Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
)

if __name__ == "__main__":
    try:
        main(tyro.cli(Command, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        _run.fail(str(error))
