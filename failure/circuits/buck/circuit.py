"""The buck converter as circuits for a search: `dcdc` at heavy load, `dcdc_light` at light load."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from failure.circuits.buck import converter, light_load
from failure.circuits.buck.reference import dcdc_reference
from failure.circuits.buck.schematic import MOSFETS, QUANTITIES
from failure.circuits.protocol import Circuit, Spec, in_chunks


def _run_dcdc(x: Float[Array, "n d"], *, model: str) -> tuple[Array, Array]:
    return in_chunks(partial(converter.solve_dcdc, model=model), x)


def _run_light(x: Float[Array, "n d"], *, model: str) -> tuple[Array, Array]:
    return in_chunks(partial(light_load.solve_dcdc_light, model=model), x)


def _no_reference(x: np.ndarray, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    raise ValueError(
        "circuit='dcdc_light': expected a circuit with an ngspice reference; its controller is an "
        "ideal state machine; its comparator and edges are those of 'dcdc', which has one"
    )


def _circuit(
    name: str,
    model: str,
    specs: tuple[Spec, ...],
    run: Callable[..., tuple[Array, Array]],
    reference: Callable[..., tuple[np.ndarray, np.ndarray]],
) -> Circuit:
    return Circuit(
        name=name if model == "ekv" else f"{name}_{model}",
        parameter_names=tuple((m.name, q) for m in MOSFETS for q, _, _ in QUANTITIES),
        sigma=tuple(s for _ in MOSFETS for _, _, s in QUANTITIES),
        parameter_units=tuple(u for _ in MOSFETS for _, u, _ in QUANTITIES),
        specs=specs,
        run=partial(run, model=model),
        reference=reference,
    )


@lru_cache(maxsize=4)
def make_dcdc(model: str = "ekv") -> Circuit:
    """The buck converter: 44 parameters, output accuracy and overshoot.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.

    Example:
        >>> make_dcdc().spec_names
        ('output_accuracy', 'overshoot')
    """
    return _circuit("dcdc", model, converter.SPECS, _run_dcdc, dcdc_reference)


@lru_cache(maxsize=4)
def make_dcdc_light(model: str = "ekv") -> Circuit:
    """The buck converter in pulse-frequency mode: 44 parameters, accuracy and ripple at 10 mA.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.

    Example:
        >>> make_dcdc_light().spec_names
        ('light_load_accuracy', 'light_load_ripple')
    """
    return _circuit("dcdc_light", model, light_load.SPECS, _run_light, _no_reference)
