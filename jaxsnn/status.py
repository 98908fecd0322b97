"""How a trial ended: one enumeration for networks, drivers and learners."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """How a trial of a robot ended, as the numbers of `TrialResult.status`.

    Example:
        >>> Status(1).label, Status.NON_FINITE.label
        ('collided', 'non finite')
    """

    ARRIVED = 0
    COLLIDED = 1
    TIMEOUT = 2
    NON_FINITE = 3
    NOT_RUN = 4

    @property
    def advice(self) -> str:
        """What to do about it."""
        return _ADVICE[self]

    @property
    def label(self) -> str:
        """The status in words."""
        return self.name.lower().replace("_", " ")


_ADVICE = {
    Status.ARRIVED: "nothing",
    Status.COLLIDED: "record the poses and look where the robot turned; train longer",
    Status.TIMEOUT: "raise max_steps, or look whether the robot turns on the spot",
    Status.NON_FINITE: "weights, pose or steering broke: lower gamma, check initial weights",
    Status.NOT_RUN: "an earlier trial of this robot ended as NON_FINITE; mend that one",
}
