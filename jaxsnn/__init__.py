"""Spiking networks that learn to steer a robot by reward-modulated STDP, and the robot's world.

Kernels: `neurons`, `plasticity`, `window`. Network: `encoding`, `rewards`, `config`,
`running_mean`, `network`, `presets`. World: `geometry`, `world`, `scenarios`, `maps`, `planner`.
All together: `agents`, `trials`, `qlearning`. Imported by name only, for what they bring along:
`jaxsnn.ppo` and `jaxsnn.navigation` (flax, optax), `jaxsnn.plots` (matplotlib), `jaxsnn.brax_env`
(brax).
"""

from jaxsnn import (
    agents,
    config,
    encoding,
    geometry,
    maps,
    network,
    neurons,
    planner,
    plasticity,
    presets,
    qlearning,
    rewards,
    running_mean,
    scenarios,
    trials,
    window,
    world,
)
from jaxsnn.maps import random_map
from jaxsnn.network import network_config, network_params
from jaxsnn.neurons import LIFParams, lif_step
from jaxsnn.plasticity import STDPParams, apply_reward, stdp_step
from jaxsnn.presets import network_setting
from jaxsnn.scenarios import scenario
from jaxsnn.trials import run_experiment, run_trial
from jaxsnn.window import stdp_window

__all__ = [
    "LIFParams",
    "STDPParams",
    "agents",
    "apply_reward",
    "config",
    "encoding",
    "geometry",
    "lif_step",
    "maps",
    "network",
    "network_config",
    "network_params",
    "network_setting",
    "neurons",
    "planner",
    "plasticity",
    "presets",
    "qlearning",
    "random_map",
    "rewards",
    "run_experiment",
    "run_trial",
    "running_mean",
    "scenario",
    "scenarios",
    "stdp_step",
    "stdp_window",
    "trials",
    "window",
    "world",
]
