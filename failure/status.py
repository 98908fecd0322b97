"""What became of a simulation: one enumeration for circuits, programs and searches."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Status of one sample; anything but `GOOD` is neither a pass nor a failure.

    Example:
        >>> Status(2).name, Status.TIMED_OUT.advice
        ('TIMED_OUT', 'raise timeout, or look at the kept deck and log')
    """

    NOT_FINITE_OUTPUT = -1
    """A search was given a value that is not finite with a status that said good."""
    GOOD = 0
    FAILED = 1
    TIMED_OUT = 2
    NOT_FINITE = 3
    NOT_CONVERGED = 4

    @property
    def advice(self) -> str:
        """What to do about it."""
        return _ADVICE[self]

    @property
    def label(self) -> str:
        """The status in words."""
        return self.name.lower().replace("_", " ")


_ADVICE = {
    Status.NOT_FINITE_OUTPUT: "let the simulator report a status where it has no value",
    Status.GOOD: "nothing",
    Status.FAILED: "read the message of the sample; run its kept deck by hand",
    Status.TIMED_OUT: "raise timeout, or look at the kept deck and log",
    Status.NOT_FINITE: "say what a missing value means: a failure, or nothing (invalid)",
    Status.NOT_CONVERGED: "accuracy could not be held: simulate the sample with ngspice",
}
