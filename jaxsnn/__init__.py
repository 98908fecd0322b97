"""Spiking networks that learn to steer a robot by reward-modulated STDP, and the robot's world.

The names below are the public ones. Kernels: `neurons`, `plasticity`, `window`, `encoding`.
Network: `config`, `presets`, `agents`. World: `maps`, `scenarios`, `planner`, and `world`, whose
`reset`, `observe` and `step` move one robot. All together: `trials`, `experiment`, `qlearning`.
Imported by name only, for what they bring along: `jaxsnn.ppo` and `jaxsnn.navigation` (flax,
optax), `jaxsnn.plots` (matplotlib), `jaxsnn.brax_env` (brax).
"""

from jaxsnn.agents import Agent, SNNParams, snn_agent, snn_params
from jaxsnn.config import NetworkConfig, NetworkParams, Weights
from jaxsnn.drivers import DriverParams, drive
from jaxsnn.encoding import poisson_spikes
from jaxsnn.experiment import Experiment, run_experiment
from jaxsnn.families import family_map
from jaxsnn.maps import make_map, random_map, stack_maps
from jaxsnn.neurons import LIFParams, LIFState, lif_init, lif_scan, lif_step
from jaxsnn.planner import shortest_path
from jaxsnn.plasticity import STDPParams, STDPState, apply_reward, stdp_init, stdp_step
from jaxsnn.presets import preset
from jaxsnn.qlearning import QParams
from jaxsnn.rewards import RewardParams
from jaxsnn.scenarios import detour, scenario
from jaxsnn.status import Status
from jaxsnn.trials import TrialResult, run_phase, success_rate
from jaxsnn.window import stdp_kernel, stdp_window
from jaxsnn.world import WorldParams

__all__ = [
    "Agent",
    "DriverParams",
    "Experiment",
    "LIFParams",
    "LIFState",
    "NetworkConfig",
    "NetworkParams",
    "QParams",
    "RewardParams",
    "SNNParams",
    "STDPParams",
    "STDPState",
    "Status",
    "TrialResult",
    "Weights",
    "WorldParams",
    "apply_reward",
    "detour",
    "drive",
    "family_map",
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
    "shortest_path",
    "snn_agent",
    "snn_params",
    "stack_maps",
    "stdp_init",
    "stdp_kernel",
    "stdp_step",
    "stdp_window",
    "success_rate",
]
