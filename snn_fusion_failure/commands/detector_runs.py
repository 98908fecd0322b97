"""How a detector's run and its cache are found from the options; what a run was trained with."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_options import OfRun, Prepare, Train
from snn_fusion_failure.runs import apply_changes, to_jsonable

# Options that do not change the numbers of a run.
NOT_SETTINGS = ("out", "resume", "overwrite", "data", "cache", "checkpoint_every", "devices")

_OLD_NAMES = {"config": "model", "preset": "size"}  # of options, in runs until 0.2
_OLD_OPTIONS = {
    "norm": "detector.norm", "normalizer": "detector.normalizer",
    "path_drop": "detector.path_drop", "truth_proposals": "detector.truth_proposals",
    "alpha": "params.gate.alpha", "beta": "params.gate.beta", "tau": "params.gate.tau",
}  # fmt: skip


def cache_folder(config: Prepare | Train | OfRun) -> Path:
    """Where the examples of a data folder and size are."""
    return config.cache or config.data / f"cache_{config.size}"


def run_folder(config: Train | OfRun) -> Path:
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


def run_config(folder: Path, config: OfRun) -> Train:
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
    if not setup.config.weighs:
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
        for key, old, new in _differences(held.get(part, {}), now):
            raise ValueError(
                f"{folder} was trained with {key}={old}, not {new}: give the settings of the run, "
                "or train in another folder (--name, --out)"
            )


def _differences(before: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Name, old and new value of the settings that both have and that differ.

    A setting that is new since then has its default, which changes nothing.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(now.keys() & before.keys()):
            yield from _differences(before[key], now[key], f"{name}.{key}" if name else key)
    elif before != now:
        yield name, before, now
