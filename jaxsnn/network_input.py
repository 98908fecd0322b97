"""What the input neurons of a network do for a reading: rates of its groups, and of each neuron."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import require
from jaxsnn.config import NetworkConfig, NetworkParams
from jaxsnn.encoding import RateTable, group_rates, interval_rates
from jaxsnn.world import Reading


def input_rates(
    config: NetworkConfig,
    params: NetworkParams,
    reading: Reading,
    recent_turn: Float[Array, ""],
    *,
    table: RateTable | None = None,
) -> Float[Array, " n_in"]:
    """Firing rate of each input neuron for a reading [Hz].

    Args:
        config: NetworkConfig.
        params: NetworkParams.
        reading: of the sensors.
        recent_turn: leaky mean of the last turns [deg], for `config.turn_groups`.
        table: `config.rates`, worked out once.
    """
    rates = group_input(config, params, reading, recent_turn, table=table)
    return jnp.repeat(rates, config.group_exc + config.group_inh)


def group_input(
    config: NetworkConfig,
    params: NetworkParams,
    reading: Reading,
    recent_turn: Float[Array, ""],
    *,
    table: RateTable | None = None,
) -> Float[Array, " groups"]:
    """Firing rate of each input group for a reading [Hz]; arguments as for `input_rates`."""
    n = reading.sonar.shape[0]
    require(
        n == config.n_sonars,
        f"n_sonars={config.n_sonars}: expected the {n} sonars of the map's robot; give the network "
        "as many",
    )
    sensed = (reading.sonar, reading.distance, reading.angle)
    if config.input_code == "interval":
        rates = interval_rates(params.interval_rate, *sensed)
    else:
        rates = group_rates(config.rates if table is None else table, *sensed)
    if config.turn_groups:
        both = jnp.clip(jnp.stack([recent_turn, -recent_turn]) / 60.0, 0.0, 1.0)
        rates = jnp.concatenate([rates, (params.turn_rate * both).astype(rates.dtype)])
    return rates
