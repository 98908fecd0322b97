"""A search whose simulations end at different times: a worker that is free gets the next point."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np

from failure.identities import identity_of
from failure.search import bayesopt, storage
from failure.search.evaluation import Evaluated, Simulate, check_worked, evaluate
from failure.search.history import SearchState
from failure.search.methods import METHODS, SearchConfig
from failure.search.runs import load
from failure.search.task import sign_of


class _Point(NamedTuple):
    """A point that waits for a worker or is at one."""

    x: np.ndarray
    u: np.ndarray
    clipped: np.ndarray


def _split(pending: tuple[np.ndarray, np.ndarray, np.ndarray]) -> list[_Point]:
    x, u, clipped = pending
    return [_Point(*(part[:, k : k + 1] for part in (x, u, clipped))) for k in range(x.shape[1])]


def run_workers(
    config: SearchConfig,
    simulate: Simulate,
    column: int = 0,
    *,
    workers: int,
    sense: str = "max",
    folder: Path | str | None = None,
    retries: int = 1,
    on_step: Callable[[SearchState], None] | None = None,
    identity: str | None = None,
) -> SearchState:
    """`run_search` for one seed with `workers` simulations at a time, none of which waits.

    As soon as one simulation ends, its result is told and the next point, which was chosen while
    all workers were busy, starts. A point is chosen as if those under way had come out as
    predicted. The order of the history is that in which simulations end; a folder goes on where it
    stopped, and points that were under way are asked anew.

    Args:
        config: the search; one seed, a surrogate, and acquisitions that give one point at a time.
        simulate: `x [1, D] -> (specs [1, m], status [1])`; called from several threads.
        column: which specification.
        workers: simulations at a time.
        sense: "max" when larger is worse, "min" when smaller is.
        folder: where the run is written.
        retries: further attempts at a point whose simulation failed.
        on_step: called after every result.
        identity: name of the simulator in the folder.

    Returns:
        The complete history.

    Raises:
        ValueError: several seeds; a method without a surrogate, with a learned space or with
            batches of its own; no worker; the folder holds another run.
        SimulatorError: nothing is valid after the initial design; see `run_search`.

    Example:
        >>> def simulate(x):
        ...     return (x**2).sum(1, keepdims=True), np.zeros(len(x))
        >>> from failure.search.task import Task
        >>> config = SearchConfig(Task("ball", 3.0, 2), "full", n_init=4, n_total=6)
        >>> run_workers(config, simulate, workers=2).y.shape
        (1, 6)
    """
    sign_of(sense)
    if len(config.seeds) != 1:
        raise ValueError(f"seeds={config.seeds}: expected one; run the others beside it")
    method = METHODS[config.method]
    if not method.surrogate or method.learned or method.acquisition == "pbo":
        raise ValueError(
            f"method={config.method!r}: expected one that asks for single points in a space that "
            "stays as it is, 'full' or 'turbo'"
        )
    if workers < 1:
        raise ValueError(f"workers={workers}: expected at least 1")
    state, mark, told = bayesopt.init(config), "", list[str]()
    if folder is not None:
        folder = Path(folder)
        name = identity_of(simulate) if identity is None else identity
        mark = storage.claim(folder, config, column=column, sense=sense, simulator=name, start=None)
        state = load(config, folder, mark)
        told = storage.messages(folder)
    ready: deque[_Point] = deque()
    running: dict[Future[Evaluated], _Point] = {}

    def choose() -> None:
        """One more point, or the initial design."""
        nonlocal state
        under_way = [point.u for point in (*running.values(), *ready)]
        busy = np.concatenate(under_way, axis=1) if under_way and state.n else None
        _, state = bayesopt.ask(config, state, busy=busy)
        assert state.pending is not None
        ready.extend(_split(state.pending))
        state = state._replace(pending=None)

    def finish(done: Future[Evaluated]) -> None:
        nonlocal state
        point, found = running.pop(done), done.result()
        state = bayesopt.tell(
            config, state._replace(pending=(point.x, point.u, point.clipped)), found.y, found.status
        )
        if isinstance(folder, Path):
            storage.append_log(folder, mark, state, 1, found.messages)
        if on_step is not None:
            on_step(state)
        told.extend(found.messages.values())
        check_worked(state.y, state.status, config.n_init, told)

    with ThreadPoolExecutor(workers) as pool:
        while state.n < config.n_total:
            left = config.n_total - state.n - len(running)
            while ready and len(running) < workers:
                point = ready.popleft()
                work = pool.submit(
                    evaluate, simulate, column, point.x, sense=sense, retries=retries
                )
                running[work] = point
                left -= 1
            # Half of the initial design is enough to choose from: one slow simulation of it must
            # not keep the other workers waiting.
            known = 2 * state.n >= config.n_init or not (running or ready)
            if not ready and left > 0 and known:
                choose()
                continue
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for done in ended:
                finish(done)
    check_worked(state.y, state.status, config.n_init, told)
    return state
