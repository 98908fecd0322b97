"""Checkpoints of a training with the settings that it belongs to."""

from __future__ import annotations

import dataclasses
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fusion.train import TrainState

History = list[dict[str, float]]


def settings_of(**parts: Any) -> dict[str, Any]:
    """Containers as flat JSON: `model.encoder.features` -> 64; arrays as shape and checksum."""
    found: dict[str, Any] = {}

    def add(name: str, value: Any) -> None:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        elif hasattr(value, "_asdict"):
            value = value._asdict()
        if isinstance(value, dict):
            for key, inner in value.items():
                add(f"{name}.{key}", inner)
        elif hasattr(value, "shape") and np.ndim(value):
            array = np.ascontiguousarray(value)
            found[name] = f"array {array.shape} {zlib.crc32(array.tobytes()):08x}"
        elif isinstance(value, tuple) and len(repr(value)) > 80:
            found[name] = f"tuple of {len(value)} {zlib.crc32(repr(value).encode()):08x}"
        elif isinstance(value, int | str) or value is None:
            found[name] = value
        elif isinstance(value, tuple):
            found[name] = repr(value)
        else:
            found[name] = float(value)

    for name, part in parts.items():
        add(name, part)
    return found


class Checkpoints:
    """Orbax checkpoints of (state, history, settings); orbax is loaded when one is wanted."""

    def __init__(self, folder: Path, settings: dict[str, Any], minutes: float) -> None:
        import orbax.checkpoint as ocp

        self._ocp = ocp
        self._folder, self._settings = folder, settings
        self._seconds, self._saved = 60.0 * minutes, time.monotonic()
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options)

    def is_due(self) -> bool:
        """Whether the last save is long ago."""
        return time.monotonic() - self._saved >= self._seconds

    def save(self, epoch: int, state: TrainState, history: History) -> None:
        """Keep what was computed up to this epoch, once."""
        if epoch == 0 or epoch in self._manager.all_steps():
            return
        args = self._ocp.args
        self._manager.save(
            epoch,
            args=args.Composite(
                state=args.StandardSave(state),
                history=args.JsonSave(history),
                settings=args.JsonSave(self._settings),
            ),
        )
        self._saved = time.monotonic()

    def restore(self, like: TrainState, *, resume: bool) -> tuple[int, TrainState, History] | None:
        """The newest checkpoint: (epoch, state, history); None where there is none.

        Raises:
            ValueError: `resume` is not set, or the settings are others.
        """
        epoch = self._manager.latest_step()
        if epoch is None:
            return None
        if not resume:
            raise ValueError(
                f"checkpoint_dir={str(self._folder)!r}: expected a folder without checkpoints; "
                "resume the run that it holds, or choose an empty folder"
            )
        args = self._ocp.args
        held = self._manager.restore(epoch, args=args.Composite(settings=args.JsonRestore()))
        self._compare(held["settings"])
        held = self._manager.restore(
            epoch,
            args=args.Composite(state=args.StandardRestore(like), history=args.JsonRestore()),
        )
        return epoch, held["state"], list(held["history"])

    def _compare(self, held: dict[str, Any]) -> None:
        names = dict.fromkeys([*held, *self._settings])
        changes = [
            f"{name}: {held.get(name)!r} -> {self._settings.get(name)!r}"
            for name in names
            if held.get(name) != self._settings.get(name)
        ]
        if changes:
            raise ValueError(
                f"resume=True: expected the settings of the run in {str(self._folder)!r}, others "
                f"are given ({'; '.join(changes[:5])}); resume with the same, or choose an empty "
                "folder"
            )

    def close(self) -> None:
        """Let go of the folder."""
        self._manager.close()
