"""What a sweep over trainings varies: numbers, traced, so that no value compiles anything anew."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float

from fusion.losses import LossParams

Number = float | Float[Array, ""]


class _Fields(NamedTuple):
    learning_rate: Number = 1e-4
    l2: Number = 5e-4
    l2_dense: Number = 5e-3
    clip_norm: Number = 10.0
    target_rate: Number = 10.0
    failure_label: Number = 1.0
    gate: LossParams = LossParams(alpha=1.0, beta=10.0, tau=0.1, anchor=30.0)


class DetectorParams(_Fields):
    """Rates and weights of a training; the defaults are the source's.

    Numbers are checked when the tuple is made; traced values and arrays are not.

    Attributes:
        learning_rate: of Adam, before the schedule.
        l2, l2_dense: weight of the squared parameters of convolutions and first stage, and of the
            second stage's dense layers.
        clip_norm: bound of the gradient's norm, lattice aside.
        target_rate: factor of the learning rate for the lattice of the targets, a few numbers that
            have to keep up with the losses of the paths.
        failure_label: weight of the cross entropy between the failure that was simulated in a
            training frame and the one that the gate tells; 0 leaves the label unused.
        gate: alpha, beta, tau and the anchor of Equation 3.2, see `fusion.losses`.

    Raises:
        ValueError: a rate or norm that is not above 0, or a negative weight.

    Example:
        >>> DetectorParams(learning_rate=1e-3).clip_norm
        10.0
    """

    __slots__ = ()

    def __new__(cls, *args: Any, **kwargs: Any) -> DetectorParams:
        """Check numbers."""
        made = super().__new__(cls, *args, **kwargs)
        for name in ("learning_rate", "clip_norm", "target_rate"):
            value = getattr(made, name)
            if isinstance(value, float | int) and not 0 < value < float("inf"):
                raise ValueError(f"{name}={value}: expected a finite number above 0")
        for name in ("l2", "l2_dense", "failure_label"):
            value = getattr(made, name)
            if isinstance(value, float | int) and not 0 <= value < float("inf"):
                raise ValueError(f"{name}={value}: expected a finite number of at least 0")
        return made

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> DetectorParams:  # type: ignore[override]
        # `_replace` goes this way, and would pass the checks by.
        return cls(*iterable)

    def as_arrays(self) -> DetectorParams:
        """Leaves as float32 arrays, so that a compiled step does not depend on Python types."""
        return jax.tree.map(lambda x: jax.numpy.asarray(x, jax.numpy.float32), self)
