"""The encoder of K sensors as a flax module: samples in, mean spikes of the last layer out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.spiking.codes import code_channels
from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import Params, draw_layer
from fusion.spiking.layers import Activity, StackState, feed, readout, run_stack, stack_start


def stack_params(config: SpikingConfig, variables: Params) -> list[Params]:
    """The layers' parameters out of the flat parameters of the module."""
    return [
        {
            name.removeprefix(f"layer{i}_"): value
            for name, value in variables.items()
            if name.startswith(f"layer{i}_")
        }
        for i in range(len(config.widths))
    ]


def scalar_config(config: SpikingConfig) -> SpikingConfig:
    """The same stack without delays and strides, for scalars, which are held and have no level."""
    ones = (1,) * len(config.widths)
    code = "current" if config.analog else config.code
    return dataclasses.replace(config, code=code, taps=ones, strides=ones)


def run_encoder(
    config: SpikingConfig,
    params: Params,
    x: Float[Array, "k b t"],
    *,
    expand: Callable[[Array], Array] | None = None,
) -> tuple[StackState, Activity]:
    """Features and activity of whole windows.

    Args:
        config: of the stack.
        params: flat, as the module has them.
        x: windows of K sensors; one sample each is held for `config.steps` steps.
        expand: features of a scalar that are injected as currents, `[k, b, 1] -> [k, b, c]`.

    Returns:
        The state after the window, for `layers.readout`, and the activity of all layers.
    """
    k, b, t = x.shape
    if t > 1:
        stack = stack_params(config, params)
        return feed(config, stack, stack_start(config, k, b), x)
    config = scalar_config(config)
    stack = stack_params(config, params)
    if config.code != "current":
        repeated = jnp.broadcast_to(x, (k, b, config.steps))
        return feed(config, stack, stack_start(config, k, b), repeated)
    values = x if expand is None else expand(x)
    held = jnp.broadcast_to(values, (config.steps, *values.shape)).astype(jnp.float32)
    start = stack_start(config, k, b, values.shape[-1])
    return run_stack(config, stack, start, held, held=True)


def _draw_one(
    config: SpikingConfig, k: int, layer: int, channels: int, name: str | None, key: Array
) -> Any:
    """One parameter of a layer, or all of them."""
    drawn = draw_layer(config, k, layer, channels, key=key)
    return drawn if name is None else drawn[name]


class SpikingEncoder(nn.Module):
    """Encode windows of K sensors by a spiking network each.

    `[branch, batch, time] -> [branch, batch, features]`, as `fusion.encoders.SeriesEncoder`.

    Attributes:
        config: code, layers, neurons, read-out.
        expand: features of a scalar that are injected as currents.
    """

    config: SpikingConfig
    expand: Callable[[Any], Any] | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "k b t"]) -> Float[Array, "k b f"]:
        """Return one feature vector per sensor and example."""
        k, _, t = x.shape
        config = self.config if t > 1 else scalar_config(self.config)
        channels = code_channels(config)
        if t == 1 and config.code == "current" and self.expand is not None:
            channels = self.expand(x[:, :1]).shape[-1]
        params: Params = {}
        for layer, width in enumerate(config.widths):
            draw = functools.partial(_draw_one, config, k, layer, channels)
            for name in jax.eval_shape(functools.partial(draw, None), jax.random.key(0)):
                full = f"layer{layer}_{name}"
                params[full] = self.param(full, functools.partial(draw, name))
            channels = width
        if config.learning != "surrogate":
            params = jax.lax.stop_gradient(params)
        state, _ = run_encoder(self.config, params, x, expand=self.expand)
        return readout(self.config, state)
