"""The folder of a sweep: `sweep.json` says what it is, `chunks/` holds what is done, file by file.

Files appear whole or not at all and are never changed, so any number of workers on any number of
machines may share a folder. Which trials a chunk holds is settled when the folder is made.
"""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs import provenance, to_jsonable, write_json
from snn_fusion_failure.sweeps.designs import Axis, Design
from snn_fusion_failure.sweeps.study import Study, load_study

__all__ = [
    "FAILED", "MISSING", "NON_FINITE", "OK", "STATUS", "Sweep", "chunk_path", "claim",
    "done_chunks", "forget", "held_sweep", "load_chunk", "save_chunk",
]  # fmt: skip

OK, NON_FINITE, FAILED, MISSING = 0, 1, 2, 3
STATUS = ("ok", "non-finite", "failed", "missing")


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep as its folder has it.

    Attributes:
        out: the folder.
        study: what a trial is.
        design: the settings.
        seeds: trials per setting; trial `i` is seed `i % seeds` of setting `i // seeds`.
        root: seed of all keys.
        chunk_trials: trials per file.
        width: trials side by side on a device.
        budgets: units of training after which settings are dropped; empty without halving.
        keep: share of the settings that stay at each of them.
    """

    out: Path
    study: Study
    design: Design
    seeds: int
    root: int
    chunk_trials: int
    width: int
    budgets: tuple[int, ...] = ()
    keep: float = 0.25

    @property
    def n_trials(self) -> int:
        """Trials of the whole design."""
        return self.design.n * self.seeds

    def columns(self, trials: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the axes for some trials."""
        rows = self.design.values[np.asarray(trials) // self.seeds]
        return {axis.leaf: rows[:, i] for i, axis in enumerate(self.design.axes)}

    def settings(self) -> dict[str, Any]:
        """What defines the numbers, JSON values."""
        value = {
            "study": self.study.name,
            "options": self.study.options,
            "design": self.design.kind,
            "axes": [axis._asdict() for axis in self.design.axes],
            "values": self.design.values,
            "shape": self.design.shape,
            "seeds": self.seeds,
            "root": self.root,
            "halving": {"budgets": self.budgets, "keep": self.keep} if self.budgets else None,
        }
        return dict(json.loads(json.dumps(to_jsonable(value))))


def claim(sweep: Sweep, **layout: Any) -> Sweep:
    """Make the folder, or join the one that is there.

    Workers may claim at the same time: the first one's file stands, the others read it. Layout
    (chunk size, trials per file) is that of the folder, since it does not change numbers.

    Raises:
        ValueError: the folder holds another sweep; the message lists what differs.
    """
    path = sweep.out / "sweep.json"
    wanted = sweep.settings()
    shape = {"chunk_trials": sweep.chunk_trials, "chunk_size": sweep.width, **layout}
    text = {"settings": wanted, "layout": shape, **provenance(), "packages": _versions()}
    sweep.out.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        handle, temporary = tempfile.mkstemp(dir=sweep.out, prefix=".sweep.json.")
        os.close(handle)
        try:
            write_json(Path(temporary), text)
            # A link, unlike a rename, fails where the file exists: one claim wins.
            os.link(temporary, path)
        except FileExistsError:
            pass
        finally:
            Path(temporary).unlink(missing_ok=True)
    held = json.loads(path.read_text(encoding="utf-8"))
    differences = _differences(held["settings"], wanted)
    if differences:
        raise ValueError(
            f"{sweep.out} holds a sweep with other settings ({'; '.join(differences)}); give the "
            "same settings to go on with it, another --out, or --overwrite to delete it"
        )
    layout = held["layout"]
    return dataclasses.replace(
        sweep, chunk_trials=layout["chunk_trials"], width=layout["chunk_size"]
    )


def _differences(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """`name: old -> new` for what a user would have to change; values follow from the axes."""
    found = []
    for name in sorted({*held, *wanted} - {"values", "shape"}):
        old, new = held.get(name), wanted.get(name)
        if old == new:
            continue
        if name == "options" and isinstance(old, dict) and isinstance(new, dict):
            keys = sorted(k for k in {*old, *new} if old.get(k) != new.get(k))
            found += [f"{k}: {old.get(k)!r} -> {new.get(k)!r}" for k in keys]
        elif name == "axes":
            found.append(f"axes: {_axes_text(old)} -> {_axes_text(new)}")
        else:
            found.append(f"{name}: {old!r} -> {new!r}")
    if not found and held != wanted:
        found.append("values of the axes (another design seed)")
    return found


def _axes_text(axes: Any) -> str:
    parts = []
    for axis in axes or ():
        values = axis["values"]
        few = ",".join(f"{v:g}" for v in values[:4]) + (",..." if len(values) > 4 else "")
        parts.append(f"{axis['leaf']}={few}" if values else
                     f"{axis['leaf']}={axis['low']:g}:{axis['high']:g}")  # fmt: skip
    return " ".join(parts)


def _versions() -> dict[str, str]:
    from importlib import metadata

    return {name: metadata.version(name) for name in ("snn-fusion-failure", "scipy", "xarray")}


def held_sweep(out: Path) -> Sweep:
    """The sweep that a folder holds.

    Raises:
        ValueError: there is none.
    """
    path = out / "sweep.json"
    if not path.exists():
        raise ValueError(f"{out} holds no sweep (no sweep.json in it)")
    held = json.loads(path.read_text(encoding="utf-8"))
    s, layout = held["settings"], held["layout"]
    axes = tuple(Axis(**{**a, "values": tuple(a["values"])}) for a in s["axes"])
    design = Design(s["design"], axes, np.asarray(s["values"], np.float64), tuple(s["shape"]))
    halving = s["halving"] or {"budgets": (), "keep": 0.25}
    return Sweep(
        out, load_study(s["study"], held=s["options"]), design, s["seeds"], s["root"],
        layout["chunk_trials"], layout["chunk_size"], tuple(halving["budgets"]), halving["keep"],
    )  # fmt: skip


def forget(out: Path) -> None:
    """Delete the sweep in a folder, and nothing else that is in it."""
    for path in out.glob("chunks*/[0-9]*.npz"):
        path.unlink()
    for name in ("sweep.json", "results.nc"):
        (out / name).unlink(missing_ok=True)


def chunk_path(sweep: Sweep, chunk: int, budget: int | None = None) -> Path:
    """File of a chunk; those of a smaller budget lie apart."""
    return _chunk_folder(sweep, budget) / f"{chunk:06d}.npz"


def _chunk_folder(sweep: Sweep, budget: int | None) -> Path:
    return sweep.out / ("chunks" if budget is None else f"chunks_{budget}")


def done_chunks(sweep: Sweep, budget: int | None = None) -> set[int]:
    """Numbers of the chunks whose files are there."""
    folder = _chunk_folder(sweep, budget)
    if not folder.is_dir():
        return set()
    names = (name.removesuffix(".npz") for name in os.listdir(folder) if name.endswith(".npz"))
    return {int(name) for name in names if name.isdigit()}


def save_chunk(
    path: Path,
    trials: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    status: np.ndarray,
    *,
    seconds: float,
    message: str = "",
) -> None:
    """Write a chunk atomically: a reader sees all of it or nothing, even after a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The name begins with a dot and does not end in .npz: no reader takes it for a chunk.
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            arrays: dict[str, Any] = {
                f"metric_{name}": np.asarray(v) for name, v in metrics.items()
            }
            np.savez(
                file, trial=trials, status=status, seconds=np.asarray(seconds),
                message=np.asarray(message),
                **arrays,
            )  # fmt: skip
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def load_chunk(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """`trial`, `status`, `seconds`, `message` and the named metrics of a chunk file."""
    with np.load(path) as data:
        held = {name: data[f"metric_{name}"] for name in names}
        held |= {name: data[name] for name in ("trial", "status")}
        return held | {"seconds": float(data["seconds"]), "message": str(data["message"])}
