"""The part of the demo that searches for failures, on a circuit that is a formula."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from failure import circuits
from failure.circuits import Circuit, Spec
from snn_fusion_failure.commands import demo

SLOPE = np.array([1.0, -2.0, 0.5, 3.0])


def _run(x: Any) -> tuple[Any, Any]:
    """A margin that shrinks along one direction; smaller is worse."""
    y = 10.0 - x @ jnp.asarray(SLOPE, x.dtype)
    return y[:, None], jnp.zeros(x.shape[0], jnp.int32)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    names = tuple((t, q) for t in ("M1", "M2") for q in ("length", "threshold"))
    circuit = Circuit(
        "toy", names, (0.01,) * 4, ("1", "V", "1", "V"),
        (Spec("margin", "V", "min", "what is left"),), _run, _run,
    )  # fmt: skip
    monkeypatch.setitem(circuits.CIRCUITS, "toy", lambda: circuit)


@pytest.mark.usefixtures("toy")
def test_failure_search_finds_the_corner(tmp_path: Path) -> None:
    config = demo.Config(out=tmp_path)
    found = demo.failure_search(
        config, circuit="toy", spec="margin", method="gradient_corner", n_total=60
    )
    # Nominal 10, worst corner 10 - 3 * 6.5 = -9.5; the threshold is 90 % of the way.
    assert np.isclose(found["threshold"], 10.0 - 0.9 * 19.5, atol=1e-3)
    assert np.isclose(found["worst"], -9.5)
    assert found["searches_with_failure"] == 2 and 1 <= found["first_failure"] <= 60
    for name in ("trend.png", "worst.png"):
        assert (tmp_path / "failures" / name).stat().st_size > 5000
    again = demo.failure_search(
        config, circuit="toy", spec="margin", method="gradient_corner", n_total=60
    )
    assert again == found
