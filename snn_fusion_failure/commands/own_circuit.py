"""A circuit of the user's own for `find-failures`: a Python function of one sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from failure import circuits
from failure.circuits import Circuit, Spec
from failure.status import Status
from snn_fusion_failure.sweeps.source import find_function


class _OwnCircuit(Circuit):
    """A circuit whose samples a function computes, one after another, in this process."""

    def simulate(self, x: Any) -> Any:
        """Specifications and status of a batch of samples."""
        return self.reference(np.asarray(x))


def _only_values(x: Any) -> Any:
    raise ValueError(
        "threshold=None: expected --threshold for a circuit of your own, whose gradient is not "
        "known"
    )


def find_circuit(name: str, dimensions: int | None = None) -> Circuit:
    """A circuit by name, or `module:function` of the current directory.

    The function takes a sample `x [d]`, in units of sigma, and returns one number, of which larger
    is worse; its specification is called `value`.

    Raises:
        ValueError: an unknown name, a function that cannot be imported, or no number of dimensions.
    """
    if ":" not in name:
        if dimensions is not None:
            raise ValueError(
                f"dimensions={dimensions}: expected none for circuit {name!r}, which has its own"
            )
        return circuits.get(name)
    if dimensions is None or dimensions < 1:
        raise ValueError(
            f"dimensions={dimensions}: expected how many numbers {name} takes, at least 1"
        )
    function = find_function(name)

    def simulator(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = np.asarray([[float(function(row))] for row in x], np.float64)
        status = np.where(np.isfinite(values[:, 0]), int(Status.GOOD), int(Status.NOT_FINITE))
        return values, status

    return _OwnCircuit(
        name=name, parameter_names=tuple((f"x{i}", "sigma") for i in range(dimensions)),
        sigma=(1.0,) * dimensions, parameter_units=("1",) * dimensions,
        specs=(Spec("value", "1", "max", f"what {name} returns"),),
        run=_only_values, reference=simulator,
    )  # fmt: skip
