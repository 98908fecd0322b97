"""Checkpoints of a training and its history, by orbax (loaded when one is wanted)."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class Checkpoints:
    """A folder of checkpoints, of which the newest two are kept."""

    def __init__(self, folder: Path) -> None:
        """Open or make the folder."""
        import orbax.checkpoint as ocp

        self._ocp = ocp
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self._folder = folder
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options)

    def save(self, step: int, state: Any, history: list[dict[str, float]]) -> None:
        """Keep the state after `step` steps; a step that is kept already is left alone."""
        if step == 0 or step in self._manager.all_steps():
            return
        args = self._ocp.args
        self._manager.save(
            step,
            args=args.Composite(state=args.StandardSave(state), history=args.JsonSave(history)),
        )

    def restore(self, like: Any) -> tuple[int, Any, list[dict[str, float]]] | None:
        """Steps, state and history of the newest checkpoint; None when there is none.

        Args:
            like: a state of the same structure and shapes.

        Raises:
            ValueError: the checkpoint holds other parameters, those of an older version.
        """
        step = self._manager.latest_step()
        if step is None:
            return None
        args = self._ocp.args
        wanted = args.Composite(state=args.StandardRestore(like), history=args.JsonRestore())
        try:
            held = self._manager.restore(step, args=wanted)
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"{self._folder}, step {step}: its parameters are not those of this model and "
                f"version ({str(error).splitlines()[0]}); train it anew, or with the version that "
                "made it"
            ) from error
        return step, held["state"], list(held["history"])

    def close(self) -> None:
        """Release the folder."""
        self._manager.close()
