"""A netlist as a simulator: decks are written, the program is started, measures are read."""

from __future__ import annotations

import hashlib
import shlex
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from failure.simulators.batches import Batch, check_points
from failure.simulators.corners import Corner
from failure.simulators.deck import Deck
from failure.simulators.measures import Limit, violation
from failure.simulators.processes import Group, SimulatorError
from failure.simulators.result_cache import load_record, save_record
from failure.simulators.spice import printed_numbers, printed_trouble
from failure.simulators.variation import Variation
from failure.status import Status

NGSPICE = "ngspice -b -n {deck}"
INVALID = ("fail", "ignore", "stop")
"""What a missing or infinite measure is: a failure of its specification, nothing, or the end."""

_MEASURE_FILES = ("*.mt*", "*.ms*", "*.ma*")
"""Where simulators other than ngspice put their measures."""

_KEPT = 200
"""Decks and logs that are kept at most of each kind, so that failures leave room for odd runs."""


@dataclass
class NetlistSimulator:
    """A netlist under parameter variation: `simulate(x [n, d]) -> (violations [n, m], status [n])`.

    A violation (`failure.simulators.measures.violation`) is above 0 where the specification fails
    in one of the corners. Every run has a folder of its own, is ended after `timeout` seconds and
    cached by the text of its deck, so that other limits, more corners or another budget pay for
    nothing twice. Deck and log of every run that misses a measure (`odd_*`) or has one beyond its
    limit (`fail_*`) are kept in `keep`, 200 of each at most.

    Attributes:
        deck: the netlist.
        variation: what varies.
        limits: the specifications.
        corners: conditions in which every sample is simulated.
        command: how one deck is run; `{deck}` is its file.
        workers: runs at a time.
        timeout: limit of each run [s].
        retries: further attempts at a run that gave nothing.
        invalid: a missing or infinite measure is a failure ("fail"), nothing ("ignore": the sample
            has a status), or ends the run ("stop").
        cache: folder of finished runs, or None.
        keep: folder of decks and logs that somebody may want to see, or None.

    Raises:
        ValueError: settings out of range; names that the netlist does not define or never uses.
    """

    deck: Deck
    variation: Variation
    limits: Sequence[Limit]
    corners: Sequence[Corner] = (Corner("nominal"),)
    command: str = NGSPICE
    workers: int = 1
    timeout: float = 60.0
    retries: int = 0
    invalid: str = "fail"
    cache: Path | None = None
    keep: Path | None = None

    def __post_init__(self) -> None:
        if self.invalid not in INVALID:
            raise ValueError(f"invalid={self.invalid!r}: expected one of {', '.join(INVALID)}")
        if "{deck}" not in self.command:
            raise ValueError(
                f"command={self.command!r}: expected {{deck}} where the file's name goes"
            )
        if not self.limits:
            raise ValueError("measure=[]: expected at least one limit, such as gain>=60")
        self.deck.check(self.variation.names, what="vary")
        for corner in self.corners:
            self.deck.check((name for name, _ in corner.values), what=f"corner {corner.name}")
            if corner.section is not None and ".lib" not in self.deck.text.lower():
                raise ValueError(
                    f"corner {corner.name}: lib={corner.section!r}: expected a netlist with a line "
                    "`.lib FILE SECTION`"
                )
        program = shlex.split(self.command)[0]
        if shutil.which(program) is None:
            advice = "; apt-get install ngspice" if program == "ngspice" else ""
            raise SimulatorError(
                f"command={program!r}: expected a program on PATH; there is none{advice}"
            )
        self._nominal: np.ndarray | None = None
        self._kept: Counter[str] = Counter()
        self._from_cache = 0
        self._batch = Batch(
            len(self.names), self.workers, self.retries, self.timeout, None, True, "", 0
        )

    @property
    def identity(self) -> str:
        """What a run folder knows the simulator by: all that its answers depend on."""

        def short(*parts: object) -> str:
            return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]

        return (
            f"netlist command={self.command!r} deck={short(self.deck.text, self.deck.digest)} "
            f"vary={short(self.variation.varied, np.asarray(self.variation.correlation).tolist())} "
            f"limits={short(*self.limits)} corners={short(*self.corners)} invalid={self.invalid}"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measures, each once."""
        return tuple(dict.fromkeys(limit.name for limit in self.limits))

    @property
    def simulations(self) -> int:
        """Programs started so far; results from the cache do not count."""
        return self._batch.simulations - self._from_cache

    def values_at(self, x: Float[np.ndarray, "n d"], corner: Corner) -> Float[np.ndarray, "n d"]:
        """Physical values of the varied parameters of samples in a corner."""
        changed = dict(corner.values)
        base = [changed.get(name) for name in self.variation.names]
        nominal = np.array(
            [
                self.deck.value(name) if value is None else value
                for name, value in zip(self.variation.names, base, strict=True)
            ]
        )
        return self.variation.physical(x, nominal)

    def deck_of(self, x: Float[np.ndarray, "d"], corner: Corner) -> str:
        """The deck of one sample in one corner."""
        values = dict(corner.values)
        values.update(
            zip(self.variation.names, self.values_at(x[None], corner)[0].tolist(), strict=True)
        )
        return self.deck.render(values, temperature=corner.temperature, section=corner.section)

    def measure(
        self, x: Float[np.ndarray, "n d"]
    ) -> tuple[Float[np.ndarray, "n c m"], Int[np.ndarray, "n c"]]:
        """Measured values of samples in every corner, NaN where one is missing.

        Raises:
            SimulatorError: the program cannot be started, or a measure is missing and `invalid`
                is "stop".
        """
        x = check_points(x, len(self.variation.names))
        n, c = len(x), len(self.corners)
        rows = np.concatenate(
            [np.repeat(x, c, axis=0), np.tile(np.arange(c, dtype=np.float64), n)[:, None]], axis=1
        )
        values, status = self._batch.run(rows, lambda group: _Run(self, group))
        if self.invalid == "stop" and self._batch.messages:
            row, message = next(iter(self._batch.messages.items()))
            where = self.corners[row % c].name
            raise SimulatorError(f"sample {row // c}, corner {where}: {message}")
        return values.reshape(n, c, -1), status.reshape(n, c)

    @property
    def messages(self) -> dict[tuple[int, str], str]:
        """(row, corner) -> what went wrong, for the last call."""
        c = len(self.corners)
        return {(k // c, self.corners[k % c].name): m for k, m in self._batch.messages.items()}

    @property
    def nominal(self) -> Float[np.ndarray, "c m"]:
        """Measured values of the nominal circuit in every corner.

        Raises:
            SimulatorError: it cannot be simulated, or prints no such measure.
            ValueError: it does not pass.
        """
        if self._nominal is None:
            values, _ = self.measure(np.zeros((1, len(self.variation.names))))
            if not np.all(np.isfinite(values)):
                (_, corner), message = next(iter(self.messages.items()))
                raise SimulatorError(f"the nominal circuit, corner {corner}: {message}")
            self._nominal = values[0]
            self.violations(values)
        return self._nominal

    def violations(self, values: Float[np.ndarray, "n c m"]) -> Float[np.ndarray, "n c k"]:
        """How far each specification is violated in each corner."""
        columns = [self.names.index(limit.name) for limit in self.limits]
        found = violation(self.limits, self.nominal[:, columns], values[..., columns])
        if self.invalid == "fail":
            found = np.where(np.isfinite(found), found, 1.0)
        return found

    def __call__(
        self, x: Float[np.ndarray, "n d"]
    ) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n"]]:
        """Violation of every specification, worst over the corners, and a status per sample."""
        _ = self.nominal
        values, status = self.measure(x)
        found = self.violations(values).max(axis=1)
        if self.invalid == "fail":
            return found, np.zeros(len(found), np.int64)
        return found, status.max(axis=1).astype(np.int64)

    def name_of(self, text: str) -> str:
        """What the cache knows a run by: command, deck, included files."""
        parts = "\0".join((self.command, self.deck.digest, text))
        return hashlib.sha256(parts.encode()).hexdigest()

    def keep_run(self, text: str, log: str, label: str) -> Path | None:
        """Keep deck and log of a run; None where nothing is kept (any more)."""
        if self.keep is None or self._kept[label] >= _KEPT:
            return None
        self._kept[label] += 1
        self.keep.mkdir(parents=True, exist_ok=True)
        path = self.keep / f"{label}_{self.name_of(text)[:12]}.cir"
        path.write_text(text, encoding="utf-8")
        path.with_suffix(".log").write_text(log, encoding="utf-8")
        return path


def _numbers(record: dict[str, Any]) -> tuple[dict[str, float], str]:
    """What a finished run has printed, by its record in the cache."""
    numbers = {str(name): float(value) for name, value in record["numbers"].items()}
    return numbers, str(record["trouble"])


class _Run:
    """One worker: sample and corner in, measures out."""

    def __init__(self, owner: NetlistSimulator, group: Group) -> None:
        self._owner, self._group = owner, group

    def __enter__(self) -> _Run:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        owner = self._owner
        text = owner.deck_of(row[:-1], owner.corners[int(row[-1])])
        path = None
        if owner.cache is not None:
            name = owner.name_of(text)
            path = Path(owner.cache) / name[:2] / f"{name}.json"
            stored = load_record(path, _numbers)
            if stored is not None:
                owner._from_cache += 1
                return self._read(*stored, Status.FAILED)
        numbers, log, status = self._simulate(text, timeout)
        trouble = printed_trouble(log)
        if not all(np.isfinite(numbers.get(n, np.nan)) for n in owner.names):
            kept = owner.keep_run(text, log, "odd")
            trouble += f" (deck and log: {kept})" if kept else ""
        elif not all(lim.low <= numbers[lim.name] <= lim.high for lim in owner.limits):
            owner.keep_run(text, log, "fail")
        # Out of time is not what the deck is: another limit may let it end.
        if path is not None and status != Status.TIMED_OUT:
            save_record(path, {"numbers": numbers, "trouble": trouble})
        return self._read(numbers, trouble, status)

    def _simulate(self, text: str, timeout: float) -> tuple[dict[str, float], str, int]:
        with tempfile.TemporaryDirectory(prefix="deck_") as folder:
            file = Path(folder) / "deck.cir"
            file.write_text(text, encoding="utf-8")
            argv = [word.replace("{deck}", str(file)) for word in shlex.split(self._owner.command)]
            done = self._group.run(argv, timeout=timeout, cwd=Path(folder))
            output = done.stdout
            for pattern in _MEASURE_FILES:
                for extra in sorted(Path(folder).glob(pattern)):
                    output += "\n" + extra.read_text(encoding="utf-8", errors="replace")
        log = f"{' '.join(argv)}\n{output}\n{done.stderr}"
        if done.returncode is None:
            return {}, f"{log}\nerror: no result after {timeout:g} s", Status.TIMED_OUT
        return printed_numbers(output), log, Status.FAILED

    def _read(self, numbers: dict[str, float], trouble: str, bad: int) -> tuple[Any, int, str]:
        names = self._owner.names
        values = [float(numbers.get(name, float("nan"))) for name in names]
        missing = [n for n, v in zip(names, values, strict=True) if not np.isfinite(v)]
        if not missing:
            return values, Status.GOOD, ""
        printed = ", ".join(numbers) or "nothing"
        message = f"no number for {', '.join(missing)}; printed: {printed}; {trouble}"
        if len(missing) == len(names):
            return None, bad, message
        return values, Status.GOOD, message
