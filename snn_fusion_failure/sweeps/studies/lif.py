r"""Study `lif`: a neuron driven by noise, and how near its firing rate comes to a target.

A test bed that runs in microseconds: one neuron with the constants of `jaxsnn.neurons.LIFParams`
gets a current `drive` with white noise of standard deviation `noise` per step. Above threshold and
without noise its rate is known, :math:`1 / (t_{ref} + \tau_m \ln \frac{RI}{RI - v_{th}})`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsnn.neurons import LIFParams, check_lif, lif_init, lif_step
from snn_fusion_failure.sweeps.study import Carry, Metric, Study

_UNITS = {
    "neuron.tau_m": "ms", "neuron.t_ref": "ms", "neuron.v_rest": "mV", "neuron.v_reset": "mV",
    "neuron.v_th": "mV", "target": "Hz",
}  # fmt: skip


class LIFStudy(NamedTuple):
    """Leaves: the neuron, its current [nA], the noise of the current [nA] and the wanted rate."""

    neuron: LIFParams = LIFParams()
    drive: float = 20.0
    noise: float = 2.0
    target: float = 40.0


def make(steps: int = 1000, dt: float = 1e-3) -> Study:
    """`steps` of `dt` seconds per trial."""
    if steps < 1:
        raise ValueError(f"steps = {steps}: expected at least 1")

    def start(params: LIFStudy, key: Any) -> Any:
        finite = jnp.ones((), bool)
        return lif_init(params.neuron, 1), jnp.zeros((), jnp.int32), finite

    def advance(params: LIFStudy, key: Any, carry: Any, begin: int, end: int) -> Any:
        def body(carry: Any, step: Any) -> Any:
            state, count, finite = carry
            noise = params.noise * jax.random.normal(jax.random.fold_in(key, step))
            current = jnp.reshape(params.drive + noise, (1,))
            state, spikes = lif_step(params.neuron, state, current, jnp.zeros(1), dt=dt)
            finite = finite & jnp.all(jnp.isfinite(state.v))
            return (state, count + jnp.sum(spikes, dtype=jnp.int32), finite), None

        carry, _ = jax.lax.scan(body, carry, jnp.arange(begin, end))
        _, count, finite = carry
        # A membrane that is not finite never fires: its rate is no number either.
        rate = count.astype(jnp.float32) / (end * dt) + jnp.where(finite, 0.0, jnp.nan)
        return carry, {"rate": rate, "error": jnp.abs(rate - params.target)}

    def trial(params: LIFStudy, key: Any) -> dict[str, Any]:
        return advance(params, key, start(params, key), 0, steps)[1]

    def advance_all(params: Any, keys: Any, carry: Any, begin: int, end: int) -> Any:
        return jax.vmap(lambda p, k, c: advance(p, k, c, begin, end))(params, keys, carry)

    def check(params: LIFStudy) -> None:
        check_lif(params.neuron, dt=dt)

    return Study(
        name="lif",
        options={"steps": steps, "dt": dt},
        params=LIFStudy(),
        run=jax.vmap(trial),
        metrics={
            "rate": Metric("Hz", "firing rate"),
            "error": Metric("Hz", "distance of the firing rate from the target", "min"),
        },
        objective="error",
        unit_of=lambda leaf: _UNITS.get(leaf, ""),
        check=check,
        with_budget=lambda budget: make(budget, dt),
        budget_text="steps",
        carry=Carry(jax.vmap(start), advance_all, steps),
    )
