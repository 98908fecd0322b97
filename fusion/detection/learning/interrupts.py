"""Ctrl-C between steps: a step that is interrupted halfway has given its buffers away already."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Hold a first Ctrl-C back until the function that is yielded is called; the second one stops.

    Outside the main thread, where Python delivers no signals, nothing is held back.

    Example:
        >>> with interrupt_between_steps() as check:
        ...     check()  # after each step; raises KeyboardInterrupt once Ctrl-C was pressed
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    before = signal.getsignal(signal.SIGINT)
    pressed = []

    def hold(number: int, frame: Any) -> None:
        pressed.append(number)
        signal.signal(signal.SIGINT, before)

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, hold)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
