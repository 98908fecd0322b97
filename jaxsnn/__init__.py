"""Spiking networks that learn to steer a robot by reward-modulated STDP, and the robot's world.

The names listed below are the public ones; the rest of the package may change.

- Kernels: `LIFParams` and `lif_init`, `lif_step`, `lif_scan`; `STDPParams` and `stdp_init`,
  `stdp_step`, or `stdp_kernel`, `stdp_window`; `apply_reward`, `poisson_spikes`.
- Networks that steer: `preset`, `snn_params`, `snn_agent`, or an `Agent` of one's own.
- The robot's world: `scenario`, `detour`, `make_map`, `random_map`; `world.reset`, `world.observe`
  and `world.step` move one robot; `drive` for drivers that do not learn.
- Trials: `run_experiment`, `run_phase`, `success_rate`, `Status`.

Imported by their full path, for what they bring along: `jaxsnn.ppo` and `jaxsnn.navigation` (flax,
optax), `jaxsnn.plots` (matplotlib), `jaxsnn.brax_env` (brax).
"""

from jaxsnn import world
from jaxsnn.agents import Agent, snn_agent, snn_params
from jaxsnn.config import NetworkConfig, NetworkParams
from jaxsnn.drivers import drive
from jaxsnn.encoding import poisson_spikes
from jaxsnn.experiment import run_experiment
from jaxsnn.maps import make_map
from jaxsnn.neurons import LIFParams, lif_init, lif_scan, lif_step
from jaxsnn.plasticity import STDPParams, apply_reward, stdp_init, stdp_step
from jaxsnn.presets import preset
from jaxsnn.random_maps import random_map
from jaxsnn.scenarios import detour, scenario
from jaxsnn.status import Status
from jaxsnn.trials import run_phase, success_rate
from jaxsnn.window import stdp_kernel, stdp_window
from jaxsnn.world import WorldParams

__all__ = [
    "Agent",
    "LIFParams",
    "NetworkConfig",
    "NetworkParams",
    "STDPParams",
    "Status",
    "WorldParams",
    "apply_reward",
    "detour",
    "drive",
    "lif_init",
    "lif_scan",
    "lif_step",
    "make_map",
    "poisson_spikes",
    "preset",
    "random_map",
    "run_experiment",
    "run_phase",
    "scenario",
    "snn_agent",
    "snn_params",
    "stdp_init",
    "stdp_kernel",
    "stdp_step",
    "stdp_window",
    "success_rate",
    "world",
]
