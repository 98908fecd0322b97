"""One chunk: compute it, take it apart where it raises, save it."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from snn_fusion_failure.runs.files import create_once
from snn_fusion_failure.runs.origin import provenance
from snn_fusion_failure.sweeps.chunkfile import DamagedError, load_chunk, save_chunk
from snn_fusion_failure.sweeps.definition import FAILED, NON_FINITE, OK, Segment, Sweep
from snn_fusion_failure.sweeps.folder import chunk_path, done_chunks
from snn_fusion_failure.sweeps.plan import read_plan, segments_of
from snn_fusion_failure.sweeps.program import Program, compile_study, out_of_memory
from snn_fusion_failure.sweeps.source import changes, fingerprint
from snn_fusion_failure.sweeps.study import Study


def check_source(sweep: Sweep) -> dict[str, Any]:
    """The fingerprint of the study's source, noted in the folder.

    Raises:
        ValueError: chunks in the folder were made by another source and mixing was not allowed.
    """
    assert sweep.study is not None
    mine = fingerprint(sweep.study.source or sweep.study.run)
    folder = sweep.out / "sources"
    others = [p for p in folder.glob("*.json") if p.stem != mine["id"]] if folder.is_dir() else []
    if others and not sweep.allow_mixed and done_chunks(sweep.out):
        held = json.loads(others[0].read_text(encoding="utf-8"))
        raise ValueError(
            f"out={sweep.out}: expected chunks of one source, but the study is not what it was on "
            f"{held['date']} ({changes(held, mine)}); go back to that, choose another --out, or "
            "give --allow-mixed to go on, which the results will say"
        )
    path = folder / f"{mine['id']}.json"
    if not path.exists():
        create_once(path, json.dumps({**mine, **provenance()}, indent=1) + "\n")
    return mine


def brief(message: str) -> str:
    """An exception's text in one line: how it begins and, of a traceback, how it ends."""
    lines = [line.strip() for line in message.strip().splitlines() if line.strip()]
    if len(lines) < 2:
        return "".join(lines)
    return f"{lines[0].removesuffix(': Traceback (most recent call last):')[:120]} ... {lines[-1]}"


class Worker:
    """Runs chunks of a sweep; compiles when the first of a kind comes, once each."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.width = sweep.width
        self.source = check_source(sweep)["id"]
        self._rows: tuple[tuple[Any, ...], ...] = ()
        self._programs: dict[str, Program] = {}
        self._studies: dict[str, Study] = {}
        self._notes: list[str] = []

    def rows(self, settings: np.ndarray) -> list[tuple[Any, ...]]:
        """Values of settings by their numbers, read again when the plan has grown."""
        if len(settings) and settings.max() >= len(self._rows):
            plan = read_plan(self.sweep.out)
            self._rows = tuple(tuple(row) for part in plan for row in part["rows"])
        return [self._rows[i] for i in settings]

    def kind(self, segment: Segment) -> str:
        """Segments of one kind share a compiled program."""
        (row,) = self.rows(np.asarray(segment.settings[:1]))
        below = self._below(segment.budget) if self._continues else None
        return json.dumps([self.sweep.static_values(row), segment.budget, below])

    def has(self, segment: Segment) -> bool:
        """Whether the program of a segment is compiled."""
        return f"{self.kind(segment)} {self.width}" in self._programs

    @property
    def _continues(self) -> bool:
        return bool(self.sweep.budgets) and self.sweep.study is not None and (
            self.sweep.study.carry is not None
        )  # fmt: skip

    def _below(self, budget: int | None) -> int:
        """The budget that ends where `budget` begins."""
        ladder = [0, *self.sweep.budgets, None]
        return ladder[ladder.index(budget) - 1] or 0

    def study(self, segment: Segment) -> Study:
        """The study of a segment: its static values, its budget. Made once: it may be traced."""
        name = self.kind(segment)
        if name not in self._studies:
            self._studies[name] = self._make_study(segment)
        return self._studies[name]

    def _make_study(self, segment: Segment) -> Study:
        study = self.sweep.study
        assert study is not None
        (row,) = self.rows(np.asarray(segment.settings[:1]))
        static = self.sweep.static_values(row)
        if static:
            assert study.variant is not None
            study = study.variant(static)
        if segment.budget is not None and not self._continues:
            assert study.with_budget is not None
            study = study.with_budget(segment.budget)
        return study

    def _needed(self, segment: Segment) -> list[str]:
        """Metrics that have to be numbers for a trial to be valid."""
        study = self.study(segment)
        if segment.budget is not None and study.carry is not None and study.carry.objective:
            return [study.carry.objective]
        return [name for name, about in study.metrics.items() if not about.optional]

    def _program(self, segment: Segment) -> Program:
        name = f"{self.kind(segment)} {self.width}"
        if name not in self._programs:
            study, span = self.study(segment), None
            if self._continues:
                assert study.carry is not None
                end = study.carry.total if segment.budget is None else segment.budget
                span = (self._below(segment.budget), end)
            self._programs[name] = compile_study(
                study, root=self.sweep.root, width=self.width, common=self.sweep.common, span=span
            )
        return self._programs[name]

    def _carried(self, segment: Segment, trials: np.ndarray) -> list[np.ndarray]:
        """What the rung below left of these trials."""
        if not self._continues or self._below(segment.budget) == 0:
            return []
        below = self._below(segment.budget)
        wanted = {(int(s), int(k)): i for i, (s, k) in enumerate(trials)}
        found: dict[int, list[np.ndarray]] = {}
        done = done_chunks(self.sweep.out)
        for part in segments_of(read_plan(self.sweep.out)):
            if part.budget != below or not set(part.settings) & {s for s, _ in wanted}:
                continue
            for number in range(part.n_chunks(self.sweep)):
                held_trials = {(int(s), int(k)) for s, k in part.chunk(self.sweep, number)}
                if (part.number, number) not in done or not held_trials & wanted.keys():
                    continue
                path = chunk_path(self.sweep.out, part.number, number)
                held = load_chunk(path, (), carry=True)
                for j, (s, k) in enumerate(held["trial"].tolist()):
                    if (s, k) in wanted and held["status"][j] in (OK, NON_FINITE):
                        found[wanted[(s, k)]] = [leaf[j] for leaf in held["carry"]]
        if len(found) < len(trials):
            lost = [tuple(map(int, trials[i])) for i in range(len(trials)) if i not in found]
            raise ValueError(f"trials {lost[:3]} have no state at budget {below}")
        n_leaves = len(found[0])
        return [np.stack([found[i][leaf] for i in range(len(trials))]) for leaf in range(n_leaves)]

    def _compute(
        self, segment: Segment, trials: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, list[np.ndarray], dict[int, str]]:
        """Metrics, status, carry and messages; halves until what raises stands alone."""
        rows = self.rows(trials[:, 0])
        n = len(trials)
        try:
            carry = self._carried(segment, trials)
            metrics, state = self._program(segment)(
                self.sweep.columns(rows), self.sweep.words(rows), trials[:, 1], carry
            )
        except DamagedError:
            raise  # not the trial's fault: whoever runs the chunks sets the file aside
        except Exception as error:
            if out_of_memory(error) and self.width > 1:
                self.width = -(-self.width // 2)
                self._programs.clear()
                self._notes.append(f"memory ran out; chunk size {self.width} from here on")
                return self._compute(segment, trials)
            if n == 1 or _many_processes():
                message = f"{type(error).__name__}: {error}"
                metrics = {name: np.full(n, np.nan) for name in self.sweep.metrics}
                return metrics, np.full(n, FAILED, np.int8), [], dict.fromkeys(range(n), message)
            half = n // 2
            first = self._compute(segment, trials[:half])
            second = self._compute(segment, trials[half:])
            return _joined(first, second, half, n)
        finite = np.all([np.isfinite(metrics[m]) for m in self._needed(segment)], axis=0)
        status = np.where(finite, OK, NON_FINITE).astype(np.int8)
        return metrics, np.broadcast_to(status, (n,)).copy(), state, {}

    def run(self, segment: Segment, number: int, *, write: bool = True) -> list[str]:
        """Run one chunk and write its file; returns what went wrong, trial by trial.

        A setting that raises is found by halving the chunk; the others keep their numbers. What an
        earlier run of the chunk left behind (`--retry-failed`) is not computed again.
        """
        sweep = self.sweep
        trials = segment.chunk(sweep, number)
        path = chunk_path(sweep.out, segment.number, number)
        start = time.perf_counter()
        self._notes.clear()
        kept = _kept(path, trials)
        todo = np.ones(len(trials), bool) if kept is None else kept["status"] == FAILED
        metrics, status, carry, messages = self._compute(segment, trials[todo])
        if kept is not None:
            metrics, status, carry = _merged(kept, todo, metrics, status, carry)
        where = np.flatnonzero(todo)
        named = {str(where[i]): message for i, message in messages.items()}
        if write:
            save_chunk(
                path, trials, sweep.words(self.rows(trials[:, 0])), metrics, status, carry=carry,
                seconds=time.perf_counter() - start, messages=named, source=self.source,
                width=self.width, notes=list(self._notes), device=_device(),
            )  # fmt: skip
            path.with_suffix(".retry").unlink(missing_ok=True)
        return list(messages.values())


def _many_processes() -> bool:
    import jax

    return jax.process_count() > 1


def _device() -> str:
    import jax

    device = jax.devices()[0]
    return f"{device.platform}: {device.device_kind}"


def _joined(first: Any, second: Any, half: int, n: int) -> Any:
    metrics = {name: np.concatenate([v, second[0][name]]) for name, v in first[0].items()}
    status = np.concatenate([first[1], second[1]])
    carry = _carry_of([(first[2], range(half)), (second[2], range(half, n))], n)
    return metrics, status, carry, first[3] | {half + i: m for i, m in second[3].items()}


def _carry_of(parts: Any, n: int) -> list[np.ndarray]:
    """Leaves of several parts in one; trials that left none are filled with zeros."""
    leaves: list[np.ndarray] = []
    for part, index in parts:
        for i, leaf in enumerate(part):
            if len(leaves) <= i:
                leaves.append(np.zeros((n, *leaf.shape[1:]), leaf.dtype))
            leaves[i][list(index)] = leaf
    return leaves


def _kept(path: Any, trials: np.ndarray) -> dict[str, Any] | None:
    retry = path.with_suffix(".retry")
    if not retry.exists():
        return None
    try:
        held = load_chunk(retry, carry=True)
    except DamagedError:
        return None
    return held if np.array_equal(held["trial"], trials) else None


def _merged(kept: Any, todo: np.ndarray, metrics: Any, status: Any, carry: Any) -> Any:
    full = {name: np.array(kept[name], np.float64) for name in metrics}
    for name, values in metrics.items():
        full[name][todo] = values
    state = np.array(kept["status"])
    state[todo] = status
    index = np.arange(len(todo))
    joined = _carry_of([(kept["carry"], index), (carry, np.flatnonzero(todo))], len(todo))
    return full, state, joined


def retry_failed(sweep: Sweep) -> int:
    """Let chunks with failed trials be run again, these trials only; returns their number."""
    count = 0
    for segment, number in sorted(done_chunks(sweep.out)):
        path = chunk_path(sweep.out, segment, number)
        try:
            failed = load_chunk(path, ())["status"] == FAILED
        except DamagedError:
            continue
        if failed.any():
            path.replace(path.with_suffix(".retry"))
            count += int(failed.sum())
    for name in (sweep.out / "dead").glob("*"):
        name.unlink()
    return count
