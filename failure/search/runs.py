"""Runs of a search against a simulator: retried, logged as they go, resumed where they end."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from failure.identities import identity_of
from failure.models.gp import GPParams
from failure.search import bayesopt, storage, trees
from failure.search.bayesopt import SearchConfig, SearchState, Surrogate
from failure.search.evaluation import Simulate, check_worked, evaluate
from failure.search.task import sign_of


def start_from(config: SearchConfig, x: np.ndarray, y: np.ndarray) -> SearchState:
    """A history made of the user's own initial data, the same for every seed.

    Args:
        config: a search in the full space or a learned one, or a baseline.
        x: `[n, D]` in sigma.
        y: `[n]`, larger is worse.

    Returns:
        SearchState as after `n` evaluations of every seed.

    Raises:
        ValueError: wrong shapes; a row that is not finite or lies outside the set, named; a
            random embedding, in which given points have no coordinates.

    Example:
        >>> from failure.search.task import Task
        >>> config = SearchConfig(Task("box", 3.0, 2), "full", seeds=(0, 1), n_init=3, n_total=8)
        >>> x = np.array([[0.0, 1.0], [2.0, -1.0], [0.5, 0.5]])
        >>> start_from(config, x, np.arange(3.0)).y.tolist()
        [[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]
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
        raise ValueError(
            f"method={config.method!r}: expected one whose points have coordinates, a random "
            "embedding cannot start from given points; use method 'full'"
        )
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


def load(config: SearchConfig, folder: Path | str, mark: str | None = None) -> SearchState:
    """The state of an interrupted run, from its folder; an empty one when there is no log yet."""
    folder = Path(folder)
    state = bayesopt.init(config)
    records = storage.read_log(folder, mark)
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
        saved = trees.load_tree(folder / "space.npz")
        if saved is not None and saved[1] <= state.n:
            state = state._replace(space=saved[0], space_at=saved[1])
        method = bayesopt.METHODS[config.method]
        # A learned space that is lost is learned again; coordinates in the old one say nothing.
        known = not method.learned or state.space is not None
        later = [r["u"] for r in records if known and r["n"] >= state.space_at]
        state = bayesopt.describe(config, state, [block for block in later if np.size(block)])
        fitted = trees.load_tree(folder / "surrogate.npz", Surrogate, {"params": GPParams})
        # A space that was trained later than the surrogate makes it worthless.
        if known and fitted is not None and state.space_at <= fitted[1] <= state.n:
            state = state._replace(surrogate=fitted[0]._replace(n_fit=fitted[1]))
    return state


def run(
    config: SearchConfig,
    simulate: Simulate,
    column: int = 0,
    *,
    sense: str = "max",
    folder: Path | str | None = None,
    state: SearchState | None = None,
    retries: int = 1,
    on_step: Callable[[SearchState], None] | None = None,
    train: bayesopt.TrainSpace | None = None,
    identity: str | None = None,
) -> SearchState:
    """Search until the budget is spent, or until the simulator shows that it never works.

    Args:
        config: the search.
        simulate: `x [n, D] -> (specs [n, m], status [n])`; all seeds' points come in one batch.
        column: which specification.
        sense: "max" when larger is worse, "min" when smaller is.
        folder: where the run is written; a run that is in it goes on, without repeating a
            simulation. Nothing is written without.
        state: a history to start from (`start_from`); it becomes the first line of the log.
        retries: further attempts at a point whose simulation failed.
        on_step: called after every batch.
        train: see `failure.search.bayesopt.ask`.
        identity: name of the simulator in the folder; see `identity_of`, which gives it without.

    Returns:
        The complete history.

    Raises:
        ValueError: `folder` holds a run with other settings, column, sense, simulator or start
            (the budget may have grown); the simulator's answer has the wrong shape.
        SimulatorError: after as many simulations as an initial design has, none is valid; it holds
            the simulator's last message. What was simulated is in the folder.

    Example:
        >>> def simulate(x):
        ...     return (x**2).sum(1, keepdims=True), np.zeros(len(x))
        >>> from failure.search.task import Task
        >>> config = SearchConfig(Task("ball", 3.0, 2), "ridge_corner", n_init=4, n_total=6)
        >>> run(config, simulate).y.shape
        (1, 6)
    """
    sign_of(sense)
    mark, given, told = "", 0 if state is None else state.n, list[str]()
    if folder is not None:
        folder = Path(folder)
        name = identity_of(simulate) if identity is None else identity
        mark = storage.claim(
            folder, config, column=column, sense=sense, simulator=name, start=state
        )
        start, state = state, load(config, folder, mark)
        if start is not None and start.n and state.n == 0:
            state = start
            storage.append_log(folder, mark, state, state.n, {})
        told = storage.messages(folder)
    elif state is None:
        state = bayesopt.init(config)
    while state.n < config.n_total:
        before = state
        x, state = bayesopt.ask(config, state, train=train)
        if folder is not None:
            if state.space is not None and state.space_at != before.space_at:
                trees.save_tree(folder / "space.npz", state.space, state.space_at)
            if state.surrogate is not None and state.surrogate is not before.surrogate:
                trees.save_tree(folder / "surrogate.npz", state.surrogate, state.surrogate.n_fit)
        found = evaluate(simulate, column, x, sense=sense, retries=retries)
        state = bayesopt.tell(config, state, found.y, found.status)
        if folder is not None:
            storage.append_log(folder, mark, state, found.y.shape[1], found.messages)
        if on_step is not None:
            on_step(state)
        told += found.messages.values()
        check_worked(state.y[:, given:], state.status[:, given:], config.n_init, told)
    check_worked(state.y, state.status, config.n_init, told)
    return state
