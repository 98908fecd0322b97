"""Runs of a search against a simulator: retried, logged as they go, resumed where they end."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from failure.bnn import BNNParams
from failure.models.gp import GPParams
from failure.revnet import RevNetParams
from failure.search import bayesopt
from failure.search.bayesopt import SearchConfig, SearchState, Surrogate
from failure.search.spaces import ReversedFeatures

__all__ = ["evaluate", "load", "run", "start_from"]

# x [n, D] -> (specs [n, m], status [n]); 0 is a valid sample
Simulate = Callable[[np.ndarray], tuple[Any, Any]]


def evaluate(
    simulate: Simulate, column: int, x: np.ndarray, *, sense: str = "max", retries: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the points of all seeds in one batch; try failed ones again; never raise for them.

    Args:
        simulate: `x [n, D] -> (specs [n, m], status [n])`.
        column: which specification.
        x: `[S, q, D]`.
        sense: "max" when larger is worse, "min" when smaller is.
        retries: further attempts at points whose simulation failed.

    Returns:
        `(y [S, q], larger is worse, NaN where invalid; status [S, q])`.
    """
    flat = np.asarray(x).reshape(-1, x.shape[-1])
    y, status = np.full(len(flat), np.nan), np.ones(len(flat), np.int64)
    left = np.arange(len(flat))
    for _ in range(retries + 1):
        try:
            specs, flags = simulate(flat[left])
            values = np.asarray(specs, np.float64)[:, column]
            flags = np.asarray(flags, np.int64)
        except (RuntimeError, OSError, ArithmeticError):
            # The simulator broke on the batch; each point keeps its failed status.
            continue
        y[left] = values if sense == "max" else -values
        status[left] = np.where((flags == 0) & ~np.isfinite(values), -1, flags)
        left = left[status[left] != 0]
        if left.size == 0:
            break
    y[status != 0] = np.nan
    return y.reshape(x.shape[:2]), status.reshape(x.shape[:2])


def start_from(config: SearchConfig, x: np.ndarray, y: np.ndarray) -> SearchState:
    """A history made of the user's own initial data, the same for every seed.

    Args:
        config: a search in the full space or a Rev-ARGate one, or a baseline.
        x: `[n, D]` in sigma.
        y: `[n]`, larger is worse.

    Raises:
        ValueError: wrong shapes; a row that is not finite or lies outside the set, named; a
            random embedding, in which given points have no coordinates.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if x.ndim != 2 or x.shape[1] != config.task.dim or y.shape != x.shape[:1]:
        raise ValueError(
            f"initial data of shapes {x.shape} and {y.shape}: expected [n, {config.task.dim}] "
            "and [n]"
        )
    if len(y) < 2:
        raise ValueError(f"initial data of {len(y)} rows: expected at least 2")
    if bayesopt.METHODS[config.method].space == "random":
        raise ValueError("a random embedding cannot start from given points; use method 'full'")
    for row in range(len(y)):
        if not (np.all(np.isfinite(x[row])) and math.isfinite(y[row])):
            raise ValueError(f"initial data, row {row}: not finite; drop it or simulate it again")
        reach = np.abs(x[row]).max() if config.task.kind == "box" else np.linalg.norm(x[row])
        if reach > config.task.size * (1 + 1e-9):
            raise ValueError(
                f"initial data, row {row}: {reach:.4g} sigma is outside the {config.task.kind} of "
                f"{config.task.size:g}; drop the row or widen the task"
            )
    copies = len(config.seeds)
    state = bayesopt.init(config)._replace(
        x=np.repeat(x[None], copies, 0),
        u=np.zeros((copies, len(y), 0)),
        y=np.repeat(y[None], copies, 0),
        status=np.zeros((copies, len(y)), np.int64),
        clipped=np.zeros((copies, len(y))),
    )
    return bayesopt.describe(config, state)


def _settings(config: SearchConfig) -> dict[str, Any]:
    """The settings as JSON gives them back."""
    settings: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    settings["task"] = config.task._asdict()
    return settings


def _write(path: Path, write: Callable[[Any], None]) -> None:
    """Replace a file in one step, so that a kill leaves the old or the new one."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def _claim(folder: Path, config: SearchConfig) -> None:
    """Write the settings of a new run, or check those of the one to resume."""
    path = folder / "search.json"
    wanted = _settings(config)
    if path.exists():
        held = json.loads(path.read_text(encoding="utf-8"))
        names = sorted(k for k in {*held, *wanted} if held.get(k) != wanted.get(k))
        if names:
            changes = "; ".join(f"{k}: {held.get(k)!r} -> {wanted.get(k)!r}" for k in names)
            raise ValueError(
                f"{folder} holds a search with other settings ({changes}); resume with the same "
                "settings or choose another folder"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    _write(path, lambda file: file.write((json.dumps(wanted, indent=1) + "\n").encode()))


def _append(folder: Path, state: SearchState, count: int) -> None:
    """Log the last `count` evaluations; one line, flushed to the disk."""
    rows = slice(state.n - count, state.n)
    line = {
        "n": state.n - count,
        "x": state.x[:, rows].tolist(),
        "u": state.u[:, rows].tolist(),
        "y": [[v if math.isfinite(v) else None for v in seed] for seed in state.y[:, rows]],
        "status": state.status[:, rows].tolist(),
        "clipped": state.clipped[:, rows].tolist(),
    }
    with (folder / "evaluations.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _save_arrays(path: Path, tree: Any, at: int) -> None:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    arrays: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
    _write(path, lambda file: np.savez(file, at=np.asarray(at), **arrays))


def _load_arrays(path: Path) -> tuple[list[Any], int]:
    with np.load(path) as data:
        leaves = [jnp.asarray(data[f"leaf{i}"]) for i in range(len(data.files) - 1)]
        return leaves, int(data["at"])


def _space_of(leaves: list[Any]) -> ReversedFeatures:
    """Rebuild a Rev-ARGate space from its leaves; fewer of them mean zeros for the rest."""
    network = RevNetParams(*leaves[:5])
    order, shift, scale, x_scale = leaves[5:9]
    rest = leaves[9:]
    restoration = None
    if rest:
        w1, b1, w2, b2, s1, c1, s2, c2 = rest[:8]
        restoration = BNNParams((w1, b1, w2, b2), (s1, c1, s2, c2), *rest[8:])
    return ReversedFeatures(network, order, shift, scale, x_scale, restoration)


def load(config: SearchConfig, folder: Path) -> SearchState:
    """The state of an interrupted run, from its folder; an empty one when there is no log yet.

    A last line that a kill has torn is dropped: its evaluation was never used.
    """
    state = bayesopt.init(config)
    path = folder / "evaluations.jsonl"
    lines = path.read_bytes().split(b"\n") if path.exists() else []
    if lines and lines[-1]:
        _write(path, lambda file: file.write(b"\n".join([*lines[:-1], b""])))
    records = [json.loads(line) for line in lines[:-1]]
    if not records:
        return state

    def joined(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(r[name], np.float64) for r in records], 1)

    with jax.enable_x64(True):
        state = state._replace(
            x=joined("x"),
            u=np.zeros((len(config.seeds), joined("y").shape[1], 0)),
            y=joined("y"),
            status=joined("status").astype(np.int64),
            clipped=joined("clipped"),
        )
        if (folder / "space.npz").exists():
            leaves, at = _load_arrays(folder / "space.npz")
            state = state._replace(space=_space_of(leaves), space_at=at)
        later = [r["u"] for r in records if r["n"] >= state.space_at]
        state = bayesopt.describe(config, state, later)
        if (folder / "surrogate.npz").exists():
            leaves, at = _load_arrays(folder / "surrogate.npz")
            # A space that was trained later than the surrogate makes it worthless.
            if at >= state.space_at:
                state = state._replace(surrogate=Surrogate(GPParams(*leaves[:3]), leaves[3], at))
    return state


def run(
    config: SearchConfig,
    simulate: Simulate,
    column: int = 0,
    *,
    sense: str = "max",
    folder: Path | None = None,
    state: SearchState | None = None,
    retries: int = 1,
    on_step: Callable[[SearchState], None] | None = None,
    train: bayesopt.TrainSpace | None = None,
) -> SearchState:
    """Search until the budget is spent.

    Args:
        config: the search.
        simulate: `x [n, D] -> (specs [n, m], status [n])`; all seeds' points come in one batch.
        column: which specification.
        sense: "max" when larger is worse.
        folder: where the run is written; a run that is in it goes on, without repeating a
            simulation. Nothing is written without.
        state: a history to start from (`start_from`), for a run without a folder.
        retries: further attempts at a point whose simulation failed.
        on_step: called after every batch.
        train: see `failure.search.bayesopt.ask`.

    Returns:
        The complete history.

    Raises:
        ValueError: `folder` holds a run with other settings.

    Example:
        >>> def simulate(x):
        ...     return (x**2).sum(1, keepdims=True), np.zeros(len(x))
        >>> from failure.search.spaces import Task
        >>> config = SearchConfig(Task("ball", 3.0, 2), "ridge_corner", n_init=4, n_total=6)
        >>> run(config, simulate).y.shape
        (1, 6)
    """
    if folder is not None:
        _claim(folder, config)
        state = load(config, folder)
    elif state is None:
        state = bayesopt.init(config)
    while state.n < config.n_total:
        before = state
        x, state = bayesopt.ask(config, state, train=train)
        if folder is not None:
            if state.space_at != before.space_at:
                _save_arrays(folder / "space.npz", state.space, state.space_at)
            if state.surrogate is not None and state.surrogate is not before.surrogate:
                tree = (*state.surrogate.params, state.surrogate.hessian_inverse)
                _save_arrays(folder / "surrogate.npz", tree, state.surrogate.n_fit)
        y, status = evaluate(simulate, column, x, sense=sense, retries=retries)
        state = bayesopt.tell(config, state, y, status)
        if folder is not None:
            _append(folder, state, y.shape[1])
        if on_step is not None:
            on_step(state)
    return state
