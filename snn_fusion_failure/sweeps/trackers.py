"""Trackers: settings and their means sent to TensorBoard, MLflow or W&B as they are finished.

Off by default. A tracker is anything with `log(setting, axes, metrics)` and `close()`; the folder
stays the only store, and what a tracker misses is never lost.
"""

from __future__ import annotations

import contextlib
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from snn_fusion_failure.sweeps.chunkfile import DamagedError
from snn_fusion_failure.sweeps.definition import MISSING, Sweep
from snn_fusion_failure.sweeps.gather import gather
from snn_fusion_failure.sweeps.rank import axis_columns, mean_of, per_setting
from snn_fusion_failure.sweeps.results import Reader


class Tracker(Protocol):
    """Where finished settings are sent."""

    def log(self, setting: int, axes: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Note a setting of which all seeds have ended."""

    def close(self) -> None:
        """Write what is left."""


class TensorBoard:
    """Event files under `OUT/tensorboard`, a run per setting with its hyper-parameters."""

    def __init__(self, sweep: Sweep) -> None:
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(str(sweep.out / "tensorboard"))

    def log(self, setting: int, axes: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """A point of each metric at the setting's number, and its values as text."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, setting)
        text = ", ".join(f"{k}={v}" for k, v in axes.items())
        self._writer.add_text("setting", text, setting)

    def close(self) -> None:
        """Flush the event file."""
        self._writer.close()


class MLflow:
    """A nested MLflow run per setting."""

    def __init__(self, sweep: Sweep) -> None:
        import mlflow

        self._mlflow = mlflow
        mlflow.set_experiment(f"sweep {sweep.study_name}")
        mlflow.start_run(run_name=sweep.out.name)

    def log(self, setting: int, axes: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """A nested run."""
        with self._mlflow.start_run(run_name=f"setting {setting}", nested=True):
            self._mlflow.log_params(dict(axes))
            self._mlflow.log_metrics(dict(metrics))

    def close(self) -> None:
        """End the run of the sweep."""
        self._mlflow.end_run()


class WandB:
    """A W&B run of the sweep with a table of settings."""

    def __init__(self, sweep: Sweep) -> None:
        import wandb

        # W&B refuses these characters, and a study of one's own is called `module:function`.
        project = re.sub(r"[/\\#?%:]+", "-", f"sweep-{sweep.study_name}")
        self._run = wandb.init(project=project, name=sweep.out.name)

    def log(self, setting: int, axes: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """A step."""
        self._run.log({**{f"axis/{k}": v for k, v in axes.items()}, **metrics}, step=setting)

    def close(self) -> None:
        """End the run."""
        self._run.finish()


TRACKERS: dict[str, tuple[Callable[[Sweep], Tracker], str]] = {
    "tensorboard": (TensorBoard, "tensorboardX"),
    "mlflow": (MLflow, "mlflow"),
    "wandb": (WandB, "wandb"),
}
"""Name -> class and the library that it needs."""


class _Watcher:
    """Sends each setting once, when all its seeds have ended."""

    def __init__(self, sweep: Sweep, tracker: Tracker | None, every: float) -> None:
        self._sweep, self._tracker, self._every = sweep, tracker, every
        self._reader = Reader(sweep.out)
        self._sent: set[int] = set()
        self._last = 0.0

    def look(self, *, now: bool = False) -> None:
        """Look for settings that have ended; at most every few seconds."""
        if self._tracker is None or not (now or time.monotonic() - self._last > self._every):
            return
        try:
            dataset = gather(self._sweep, reader=self._reader)
        except DamagedError:
            return
        status = per_setting(dataset, "status")
        columns = axis_columns(dataset)
        for setting in range(len(status)):
            if setting in self._sent or (status[setting] == MISSING).any():
                continue
            self._sent.add(setting)
            axes = {k: v[setting].item() for k, v in columns.items()}
            metrics = {m: mean_of(dataset, m, setting) for m in self._sweep.metrics}
            try:
                self._tracker.log(setting, axes, metrics)
            except Exception as error:  # A library's own, for a server that is gone or full.
                self._tracker = None
                warnings.warn(
                    f"the tracker ended and is left out from here on: {error}", stacklevel=2
                )
                return
        self._last = time.monotonic()


@contextlib.contextmanager
def make_tracker(name: str, sweep: Sweep, *, every: float = 5.0) -> Iterator[Any]:
    """Something with `look()`, to be called after chunks; it does nothing without a name.

    Raises:
        ValueError: the tracker's library is not installed, or does not start.
    """
    tracker: Tracker | None = None
    if name:
        kind, library = TRACKERS[name]
        try:
            tracker = kind(sweep)
        except ImportError as error:
            raise ValueError(
                f"tracker={name!r}: expected the library {library}; pip install {library}"
            ) from error
        except Exception as error:  # A library's own: no server, no account, no such store.
            raise ValueError(
                f"tracker={name!r}: expected {library} to start; set it up or do without; {error}"
            ) from error
    watcher = _Watcher(sweep, tracker, every)
    try:
        yield watcher
        watcher.look(now=True)
    finally:
        if tracker is not None:
            tracker.close()
