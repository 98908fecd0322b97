"""How one documented command is made quick enough to be run."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Rule:
    """How a documented command is run.

    Attributes:
        words: it is meant for commands that have all of these words; the first rule counts.
        small: options that are appended.
        not_run: why it is not run at all.
        needs: a program or a Python package that has to be there.
        forget: a file of the copy that would let the command find its work done.
        held: a file of the copy and its text, which save a search for what nobody looks at.
    """

    words: str
    small: str = ""
    not_run: str = ""
    needs: str = ""
    forget: str = ""
    held: tuple[str, str] | None = None
