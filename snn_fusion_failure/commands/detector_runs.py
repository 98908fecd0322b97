"""Options of the detector's commands, and how a run and its cache are found from them."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.runs import to_jsonable

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
    """Lists in ImageSets, the first one gives the anchor sizes; `testing`: all of ROOT/testing."""
    add: bool = False
    """Add the lists to the cache that is there; always so when `testing` comes first."""
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
    """List in ImageSets, or `testing`: result files only, since there are no labels."""
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
    loose_overlap: float = 0.5
    """Of a second score on the ground and in 3D, `3d_moderate_r40_iou50` and so on."""
    pictures: int = 2
    """Frames to draw."""
    out: Path | None = None
    """Folder of results; RUN/eval_SPLIT[_FAILURE] when left out."""


# Options that do not change the numbers of a run.
NOT_SETTINGS = ("out", "resume", "overwrite", "data", "cache", "checkpoint_every")
CLASS = "Car"


def cache_folder(config: Prepare | Train | Eval) -> Path:
    """Where the examples of a data folder and preset are."""
    return config.cache or config.data / f"cache_{config.preset}"


def run_folder(config: Train | Eval) -> Path:
    """Where a training keeps its files."""
    failing = "_failures" if config.failures else ""
    name = f"{config.data.resolve().name}_{config.config}_{config.preset}{failing}_s{config.seed}"
    return Path("runs") / "detector" / name


def build(config: Train, cache: Any) -> tuple[Any, Any]:
    """Detector and training of a command line, for a cache."""
    from fusion.detection.learning.training import training_preset

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


def load_run(folder: Path, detector: Any, training: Any) -> Any:
    """The newest state of a run folder.

    Raises:
        FileNotFoundError: no training was kept there.
    """
    from fusion.detection.learning.fitting import restore_detector

    state = restore_detector(folder / "checkpoints", detector, training)
    if state is None:
        raise FileNotFoundError(f"{folder} holds no checkpoint: run `train` first")
    return state


def run_config(folder: Path, config: Eval) -> Train:
    """The command line that a run was trained with.

    Raises:
        FileNotFoundError: there is no run.
    """
    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no run: run `train` first")
    held = json.loads(path.read_text(encoding="utf-8"))["settings"]
    held["failure_kinds"] = tuple(held["failure_kinds"])
    return Train(data=config.data, cache=config.cache, **held)


def resolved(detector: Any, training: Any) -> dict[str, Any]:
    """All settings of a training as JSON values, those of the presets too."""
    parts = {"detector": dataclasses.asdict(detector), "training": dataclasses.asdict(training)}
    for name in ("gate_params", "gate_loss"):
        value = parts["detector"][name]
        parts["detector"][name] = value._asdict() if hasattr(value, "_asdict") else value
    if detector.model == "avod":
        # What only the gate reads may differ.
        of_gate = ("gate", "targets", "auxiliary", "balanced", "normalizer")
        kept = {k: v for k, v in parts["detector"].items() if not k.startswith(of_gate)}
        parts["detector"] = kept
        parts["training"].pop("target_rate")
    held: dict[str, Any] = to_jsonable(parts)
    return held


def check_settings(folder: Path, detector: Any, training: Any) -> None:
    """Refuse a finished run whose settings are not those of this command line and these presets.

    Runs are kept and taken up again, while the presets' numbers live in the code: a run from before
    a change would be mixed with later ones. Runs that did not write their settings pass.

    Raises:
        ValueError: a setting differs; the message names it.
    """
    path = folder / "result.json"
    if not path.is_file():
        return
    held = json.loads(path.read_text(encoding="utf-8")).get("settings", {})
    for part, now in resolved(detector, training).items():
        before = held.get(part, {})
        # A setting that is new since then has its default, which changes nothing.
        for key in sorted(now.keys() & before.keys()):
            if now[key] != before[key]:
                raise ValueError(
                    f"{folder} was trained with {key}={before[key]}, not {now[key]}: give the "
                    "settings of the run, or train in another folder (--name, --out)"
                )
