"""What all failures share: the severity, and how unknown kinds are refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

Severity = Float[Array, ""] | float | int


def check_failure(
    sensor: str, kinds: Sequence[str], known: Sequence[str], severity: Severity
) -> None:
    """Refuse unknown kinds and, where it is a number already, a severity outside [0, 1].

    Raises:
        ValueError: either, or no kind at all.
    """
    unknown = [kind for kind in kinds if kind not in known]
    if unknown or not kinds:
        wrong = repr(unknown[0]) if unknown else "none given"
        raise ValueError(f"{sensor} failure {wrong}: expected one of {', '.join(known)}")
    if isinstance(severity, float | int | np.ndarray) and not 0.0 <= severity <= 1.0:
        raise ValueError(f"severity={severity}: expected a number from 0 (none) to 1")
