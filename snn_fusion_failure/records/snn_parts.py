"""Programs that time the pieces of a spiking network's window, and the same network declared."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

WINDOWS = 16
"""Windows in a row in each program, so that its call costs nothing beside them."""
_FIRST = """
import time, jax, jaxsnn
config, params = jaxsnn.preset("S4")
map, keys = jaxsnn.scenario(1), jax.random.split(jax.random.key(0), 8)
run = jax.jit(lambda k, p: jaxsnn.run_experiment(
    config, jaxsnn.snn_params(config, p), map, keys=k, n_learn=1, n_test=1, max_steps=1))
begin = time.process_time()
jax.block_until_ready(run(keys, params).testing.status)
print(time.process_time() - begin)
"""


def first_call() -> float:
    """CPU time of the first call of `run_experiment` in a process without a compile cache [s]."""
    env = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"}
    made = subprocess.run(
        [sys.executable, "-c", _FIRST], env=env, check=True, capture_output=True, text=True
    )
    return float(made.stdout.split()[-1])


def _s4(window: int, engine: str = "xla") -> tuple[Any, Any]:
    from jaxsnn.presets import preset

    size = {"control_steps": window, "hold_steps": window, "engine": engine}
    return preset("S4", "tuned", config=size)


def _rates(config: Any) -> Any:
    import jax.numpy as jnp

    return jnp.full(config.n_in, 50.0)


def by_hand(
    robots: int, window: int, part: str = "learning", engine: str = "xla"
) -> tuple[Callable[..., Any], Any]:
    """A jitted chain of windows of S4 up to a part, without a world, and the states it takes.

    Args:
        robots: how many at once.
        window: steps.
        part: "spikes" (input spikes are drawn), "neurons" (and both layers run) or "learning" (and
            the weights change by their eligibility).
        engine: of `NetworkConfig`.

    Returns:
        `(states, keys) -> states` and the first states.
    """
    import jax
    import jax.numpy as jnp

    from jaxsnn import network
    from jaxsnn.encoding import poisson_spikes

    config, params = _s4(window, engine)
    kernel = jax.jit(lambda: network.kernel(config, params))()

    def one(state: Any, key: Any) -> Any:
        def body(state: Any, index: Any) -> tuple[Any, None]:
            key_of = jax.random.fold_in(key, index)
            pre = poisson_spikes(_rates(config), window, dt=config.dt, key=key_of)
            if part == "spikes":
                seen = state.baseline_input._replace(mean=pre.mean(axis=0))
                return state._replace(baseline_input=seen), None
            if part == "neurons":
                state, spikes = network.fire(config, params, state, pre)
                seen = state.baseline_hidden._replace(mean=spikes.hidden.mean(axis=0))
                return state._replace(baseline_hidden=seen), None
            state, held, _ = network.window(config, params, kernel, state, pre)
            reward = _reward(held.output_count / held.duration)
            weights = network.reinforce(config, params, state.weights, held, reward)
            return state._replace(weights=weights), None

        return jax.lax.scan(body, state, jnp.arange(WINDOWS))[0]

    keys = jax.random.split(jax.random.key(0), robots)
    states = jax.jit(jax.vmap(lambda k: network.init(k, config, params)))(keys)
    return jax.jit(jax.vmap(one), donate_argnums=0), states


def _reward(rates: Any) -> Any:
    import jax.numpy as jnp

    error = jnp.clip((30.0 - (rates[1] - rates[0])) / 60.0, -1.0, 1.0)
    return jnp.stack([-error, error])


def as_declared(robots: int, window: int) -> tuple[Callable[..., Any], Any]:
    """The same chain of windows of the same network, put together by `jaxsnn.declared`.

    It has neither the running means nor the homeostasis of `by_hand`.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import declared
    from jaxsnn.config import neuron_signs
    from jaxsnn.encoding import poisson_spikes

    config, params = _s4(window)
    sign_in, sign_hidden = neuron_signs(config)
    half = config.n_half
    rule = declared.RewardSTDP(
        gamma=params.gamma, a_minus=-params.stdp.anti_causal, dependence="multiplicative"
    )

    def drawn(key: Any, shape: Any) -> Any:
        return jax.random.uniform(key, shape, maxval=2.5)

    net = declared.declare(
        {
            "sensors": declared.Input(config.n_in, sign_in),
            "left": declared.Population(half, sign_hidden[:half]),
            "right": declared.Population(half, sign_hidden[half:]),
            "left motor": declared.Population(1),
            "right motor": declared.Population(1),
        },
        {
            f"{pre} to {post}": declared.Projection(pre, post, drawn, rule=rule)
            for pre, post in (
                ("sensors", "left"),
                ("sensors", "right"),
                ("left", "left motor"),
                ("right", "right motor"),
            )
        },
        dt=config.dt,
    )
    constants = declared.constants(net)
    kernels = jax.jit(lambda: declared.window_kernels(net, constants, window))()
    signs = np.asarray(sign_in)[:, None], np.asarray(sign_hidden)

    def one(state: Any, key: Any) -> Any:
        def body(state: Any, index: Any) -> tuple[Any, None]:
            key_of = jax.random.fold_in(key, index)
            pre = poisson_spikes(_rates(config), window, dt=config.dt, key=key_of)
            state, held, spikes = declared.window(net, constants, kernels, state, {"sensors": pre})
            count = jnp.stack([spikes[f"{side} motor"].sum() for side in ("left", "right")])
            left, right = _reward(count / (window * config.dt))
            rewards = {
                "sensors to left": left * signs[0] * signs[1][:half],
                "sensors to right": right * signs[0] * signs[1][half:],
                "left to left motor": left * signs[1][:half, None],
                "right to right motor": right * signs[1][half:, None],
            }
            return declared.reinforce(net, constants, state, held, rewards), None

        return jax.lax.scan(body, state, jnp.arange(WINDOWS))[0]

    keys = jax.random.split(jax.random.key(0), robots)
    states = jax.jit(jax.vmap(lambda k: declared.init(k, net)))(keys)
    return jax.jit(jax.vmap(one), donate_argnums=0), states
