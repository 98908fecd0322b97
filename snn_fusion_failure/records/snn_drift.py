"""How far weights that are held for a window drift from weights that change in every step."""

from __future__ import annotations

from typing import Any


def drift_rows(seconds: float = 2.0) -> list[dict[str, Any]]:
    """Correlation and slope of the weights' change, held windows against every step."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import network
    from jaxsnn.encoding import poisson_spikes
    from jaxsnn.presets import preset

    steps = round(seconds * 1000)
    reward = jnp.array([1.0, -1.0])
    rows = []
    for speed, gamma in (("slow", 3e-4), ("fast", 3e-3)):
        changes: dict[int, tuple[Any, float]] = {}
        for hold in (1, 10, 50, 100):
            config, params = preset(
                "S4", "tuned",
                config={"control_steps": hold, "hold_steps": hold},
                params={"gamma": gamma, "homeostasis": 0.0, "centring": 0.0},
                stdp={"anti_causal": 1.0},
            )  # fmt: skip

            def run(params: Any, config: Any = config, hold: int = hold) -> Any:
                state = network.init(jax.random.key(0), config, params)
                rates = jnp.repeat(jnp.array([50.0, 100, 50, 0, 50, 50, 25]), 30)
                pre = poisson_spikes(rates, steps, key=jax.random.key(1), dt=config.dt)
                start = state.weights.hidden
                if hold == 1:
                    end, _ = jax.lax.scan(
                        lambda c, x: network.step(config, params, c, x, reward), state, pre
                    )
                else:
                    stdp = network.kernel(config, params)

                    def body(carry: Any, x: Any) -> tuple:
                        carry, held, _ = network.window(config, params, stdp, carry, x)
                        new = network.reinforce(config, params, carry.weights, held, reward)
                        return carry._replace(weights=new), None

                    end, _ = jax.lax.scan(body, state, pre.reshape(-1, hold, config.n_in))
                return end.weights.hidden - start, jnp.mean(start)

            constants = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
            change, mean = jax.jit(run)(constants)
            changes[hold] = np.asarray(change, np.float64).ravel(), float(mean)
        exact, mean = changes[1]
        for hold in (10, 50, 100):
            got = changes[hold][0]
            rows.append(
                {
                    "learning": speed,
                    "hold_ms": hold,
                    "drift": float(np.abs(exact).mean() / mean),
                    "correlation": float(np.corrcoef(exact, got)[0, 1]),
                    "slope": float(exact @ got / (exact @ exact)),
                }
            )
    return rows
