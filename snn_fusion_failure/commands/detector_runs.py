"""Options of the detector's commands, and how a run and its cache are found from them."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from snn_fusion_failure.runs import apply_changes, to_jsonable

Model = Literal["avod", "avod_argate"]
Size = Literal["paper", "small", "tiny"]
ModelOption = Annotated[Model, tyro.conf.arg(aliases=["--config"])]
SizeOption = Annotated[Size, tyro.conf.arg(aliases=["--preset"])]
Changes = Annotated[tuple[str, ...], tyro.conf.arg(name="set")]


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Check the frames of the split lists and write them as examples of fixed size."""

    data: Path
    """KITTI folder."""
    size: SizeOption = "small"
    """Of the network: `paper` (accelerators), `small` (two CPU cores), `tiny` (tests)."""
    cache: Path | None = None
    """Where the examples go; DATA/cache_SIZE when left out."""
    splits: tuple[str, ...] = ("train", "val")
    """Lists in ImageSets, the first one gives the anchor sizes; `testing`: all of ROOT/testing."""
    add: bool = False
    """Add the lists to the cache that is there; always so when `testing` comes first."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's (simulated frames)."""
    skip_bad: bool = False
    """Leave out damaged frames, and count them, instead of stopping at the first."""
    like: Path | None = None
    """A cache whose anchor sizes are taken, for frames that its detectors are evaluated on."""
    camera_height: float = 1.65
    """Of the camera above the road [m], where frames have no plane file."""
    camera_tilt: float = 8.0
    """Largest angle of the camera to the road [degree], likewise."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train one detector."""

    data: Path
    model: ModelOption = "avod_argate"
    size: SizeOption = "small"
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
    changes: Changes = ()
    """Other constants, `detector.path_drop=0` `training.flip=false` `params.gate.tau=0.2`."""
    checkpoint_every: int = 500
    out: Path | None = None
    """Run folder; runs/detector/DATA_MODEL_SIZE[_failures]_sSEED when left out."""
    resume: bool = False
    overwrite: bool = False


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluate a trained detector, all sensors working or one failed."""

    data: Path
    model: ModelOption = "avod_argate"
    size: SizeOption = "small"
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

_OLD_NAMES = {"config": "model", "preset": "size"}  # of options, in runs until 0.2
_OLD_OPTIONS = {
    "norm": "detector.norm", "normalizer": "detector.normalizer",
    "path_drop": "detector.path_drop", "truth_proposals": "detector.truth_proposals",
    "alpha": "params.gate.alpha", "beta": "params.gate.beta", "tau": "params.gate.tau",
}  # fmt: skip


def cache_folder(config: Prepare | Train | Eval) -> Path:
    """Where the examples of a data folder and size are."""
    return config.cache or config.data / f"cache_{config.size}"


def run_folder(config: Train | Eval) -> Path:
    """Where a training keeps its files."""
    failing = "_failures" if config.failures else ""
    name = f"{config.data.resolve().name}_{config.model}_{config.size}{failing}_s{config.seed}"
    return Path("runs") / "detector" / name


def build(config: Train, cache: Any) -> Any:
    """The `DetectorSetup` of a command line, for a cache."""
    from fusion.detection.presets import DetectorSetup, preset

    if cache.size != config.size:
        raise ValueError(
            f"{cache.folder} was prepared for size {cache.size!r}, not {config.size!r}: run "
            "`prepare` with the size of the training"
        )
    _, train, params = preset(config.size, config.model)
    given = {k: getattr(config, k) for k in ("steps", "batch_size")}
    changes = {k: v for k, v in given.items() if v is not None}
    if config.failures:
        changes["failure_share"] = 2.0 / 3.0
    if config.failure_kinds:
        changes["failure_kinds"] = config.failure_kinds
    if config.learning_rate is not None:
        params = params._replace(learning_rate=config.learning_rate)
    parts = {
        "detector": cache.config(config.model),
        "training": dataclasses.replace(train, **changes),
        "params": params,
    }
    made = apply_changes(parts, config.changes)
    return DetectorSetup(made["detector"], made["training"], made["params"])


def load_run(folder: Path, setup: Any) -> Any:
    """The newest state of a run folder.

    Raises:
        FileNotFoundError: no training was kept there.
    """
    from fusion.detection.learning.fitting import restore_detector

    state = restore_detector(setup.config, folder / "checkpoints")
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
    held = {_OLD_NAMES.get(k, k): v for k, v in held.items()}
    old = {k: held.pop(k) for k in _OLD_OPTIONS if k in held}
    changes = [f"{_OLD_OPTIONS[k]}={json.dumps(v)}" for k, v in old.items() if v is not None]
    held["changes"] = (*changes, *held.get("changes", ()))
    held["failure_kinds"] = tuple(held["failure_kinds"])
    return Train(data=config.data, cache=config.cache, **held)


def resolved(setup: Any) -> dict[str, Any]:
    """All settings of a training as JSON values, those of the presets too."""
    detector, training = dataclasses.asdict(setup.config), dataclasses.asdict(setup.train)
    numbers = setup.params._asdict()
    detector["gate_params"] = numbers.pop("gate")._asdict()
    training |= numbers
    if setup.config.model == "avod":
        # What only the gate reads may differ.
        of_gate = ("gate", "targets", "auxiliary", "balanced", "normalizer")
        detector = {k: v for k, v in detector.items() if not k.startswith(of_gate)}
        training.pop("target_rate")
    held: dict[str, Any] = to_jsonable({"detector": detector, "training": training})
    return held


def check_settings(folder: Path, setup: Any) -> None:
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
    for part, now in resolved(setup).items():
        before = held.get(part, {})
        # A setting that is new since then has its default, which changes nothing.
        for key in sorted(now.keys() & before.keys()):
            if now[key] != before[key]:
                raise ValueError(
                    f"{folder} was trained with {key}={before[key]}, not {now[key]}: give the "
                    "settings of the run, or train in another folder (--name, --out)"
                )
