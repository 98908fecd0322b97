"""What a command shows: a progress bar, the last `result:` line, what was wrong."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any


def progress() -> Any:
    """A rich progress bar on stderr, so that stdout stays clean for `result:`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}"),
        console=Console(stderr=True),
    )


def print_result(**fields: Any) -> None:
    """The last line of a script: `result: name=value ...`, one line, for other programs to read."""
    parts = []
    for name, value in fields.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        parts.append(f"{name}={text}")
    print("result: " + " ".join(parts), flush=True)


def fail(message: str) -> None:
    """Say what is wrong on stderr and leave with exit status 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


@contextlib.contextmanager
def live_text() -> Iterator[Callable[[str], None]]:
    """A block of text in the terminal that is drawn over again: `with live_text() as show`."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(stderr=True), refresh_per_second=20) as live:
        yield lambda text: live.update(Text(text))
