"""Options of the detector's commands."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

Model = Literal["avod", "avod_argate", "dense", "dense_argate", "dense_oracle"]
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
    copies: bool = False
    """The frames are corrupted copies of those of `--like`: ground planes are taken from there, and
    a camera or lidar may be dead."""
    target: Literal["Car", "Pedestrian", "Cyclist"] = "Car"
    """Class that detectors of this cache are trained to tell from the background."""
    camera_height: float = 1.65
    """Of the camera above the road [m], where frames have no plane file."""
    camera_tilt: float = 8.0
    """Largest angle of the camera to the road [degree], likewise."""
    beams: int | None = None
    """Of the lidar, for `lidar_beam_loss`; told from the scans when left out."""
    beam_elevations: tuple[float, ...] = ()
    """Elevations of its beams [degree], where the scans do not show them."""


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
    """Frames a step; the preset's when left out."""
    devices: int = 1
    """Local devices that share the frames of a step, of which there must be a multiple."""
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
class OfRun:
    """What names a trained run."""

    data: Path
    """KITTI folder of the run."""
    model: ModelOption = "avod_argate"
    size: SizeOption = "small"
    cache: Path | None = None
    seed: int = 0
    failures: bool = False
    """The run that was trained with failures (names the folder)."""
    run: Path | None = None
    """Run folder; named as in `train` when left out."""


@dataclasses.dataclass(frozen=True)
class Eval(OfRun):
    """Evaluate a trained detector, all sensors working or one failed."""

    split: str = "val"
    """List in ImageSets, or `testing`: result files only, since there are no labels."""
    failure: str | None = None
    """Failure in every frame, e.g. camera_blackout, lidar_loss, time_lag."""
    severity: float = 1.0
    overlap: float | None = None
    """Least overlap of a hit; the benchmark's when left out: 0.7 for cars, 0.5 for others."""
    loose_overlap: float | None = None
    """Of a second score on the ground and in 3D, `3d_moderate_r40_iou50` and so on; 0.5 for cars
    and 0.25 for others when left out."""
    pictures: int = 2
    """Frames to draw."""
    out: Path | None = None
    """Folder of results; RUN/eval_SPLIT[_FAILURE] when left out."""


@dataclasses.dataclass(frozen=True)
class Drive(OfRun):
    """A picture of a simulated drive on which a sensor dies."""

    model: ModelOption = "dense_argate"
    failure: str = "camera_fog"
    """Its severity rises from 0 to 1 in the middle third of the drive."""
    frames: int = 45
    speed: float = 5.0
    """Of the car [m/s]; ten frames a second."""
    scene: int = 0
    """Seed of the scene."""
    threshold: float = 0.3
    """Least score of a detection that is drawn."""
    fps: int = 10
    dpi: int = 80
    out: Path | None = None
    """The picture, moving (.gif) or four moments of it (.png); RUN/drive_FAILURE.gif when left
    out."""


@dataclasses.dataclass(frozen=True)
class Export(OfRun):
    """A trained run as one file that needs jax and not this package."""

    model: ModelOption = "dense_argate"
    image_size: tuple[int, int] | None = None
    """Rows and columns of the images that it will get; those of the run's first frame when left
    out."""
    points: int = 131_072
    """Rows of its scans; spare ones are NaN."""
    platforms: tuple[str, ...] = ("cpu",)
    """Where it is to run, such as `cpu cuda`."""
    out: Path | None = None
    """The program; RUN/detector.stablehlo when left out."""


@dataclasses.dataclass(frozen=True)
class Robustness(OfRun):
    """Average precision of a trained detector by failure and severity, and on corrupted folders."""

    split: str = "val"
    kinds: tuple[str, ...] | None = None
    """Failures to try; all when left out, none with `--kinds` alone."""
    levels: tuple[int, ...] = (1, 2, 3, 4, 5)
    """Severities in fifths."""
    corrupted: tuple[Path, ...] = ()
    """KITTI folders with a corrupted copy of the list's frames; each is a failure of its own."""
    overlap: float | None = None
    """Least overlap of a hit; the benchmark's when left out."""
    baseline: Path | None = None
    """A `robustness.json` of the detector that the corruption error (mCE) is measured against."""
    out: Path | None = None
    """Folder of results; RUN/robustness_SPLIT when left out. What is there is not done again, and
    refused when it was measured with other options or another training."""


@dataclasses.dataclass(frozen=True)
class Calibrate(OfRun):
    """Calibrate the failures that a trained detector tells, on frames its training did not see."""

    model: ModelOption = "dense_argate"
    split: str = "val"
    false_alarm_rate: float = 0.01
    """Share of frames with working sensors in which a sensor is called failed."""
