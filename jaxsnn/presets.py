"""Presets of the networks: what the source says, and what we found to learn better.

The reading "literal" is the source wherever it speaks; what it leaves open (window, learning rate,
time constant of the eligibility trace, threshold) has our values in both. "tuned" adds options;
"guided" takes an input group for each interval, memory of the last turns and a graded reward for
maps that need a detour; "way" is rewarded by a trainer that knows the way; "critic" is "way" with a
critic (`jaxsnn.critic`).
`docs/snn_networks.md` says what each option does and how it was chosen.
"""

from __future__ import annotations

from typing import Any

from jaxsnn._checks import require_choice
from jaxsnn.config import (
    NetworkConfig,
    NetworkParams,
    check_network,
    network_config,
    network_params,
)
from jaxsnn.plasticity import STDPParams
from jaxsnn.turn_goal import TurnGoalParams

# Per reading: changes of NetworkConfig, of NetworkParams, of STDPParams and of RewardParams.
READINGS: dict[str, dict[str, dict[str, Any]]] = {
    "literal": {
        "config": {"control_steps": 400, "hold_steps": 100},
        "params": {"gamma": 7.5e-4},
        "stdp": {"anti_causal": 1.0},
        "reward": {},
    },
    "tuned": {
        "config": {"control_steps": 200, "hold_steps": 100, "angle_code": "ring"},
        "params": {
            "gamma": 1.5e-4,
            "centring": 1.0,
            "homeostasis": 0.005,
            "rate_hidden": 25.0,
            "rate_output": 60.0,
        },
        "stdp": {"anti_causal": 0.5},
        "reward": {
            "opponent": 1.0,
            "goal_angle": 60.0,
            "commit": 1.0,
            "target_near_obstacle": 0.0,
            "d_target": 800.0,
            "r3_base": 4.0,
        },
    },
}
READINGS["guided"] = {
    "config": {
        **READINGS["tuned"]["config"],
        "input_code": "interval",
        "turn_groups": True,
        "guidance": "graded",
        "group_exc": 5,
        "group_inh": 5,
    },
    "params": {
        **READINGS["tuned"]["params"],
        "max_turn": 60.0,
        "anneal": 500.0,
        # The best of 1,024 sets on validation maps (results/study_guidance.json).
        "goal": TurnGoalParams(
            side=120.0,
            diagonal=60.0,
            front=60.0,
            blocked=180.0,
            avoid=30.0,
            towards=45.0,
            commitment=0.5,
            memory=0.97,
        ),
    },
    "stdp": READINGS["tuned"]["stdp"],
    "reward": READINGS["tuned"]["reward"],
}
READINGS["way"] = {
    **READINGS["guided"],
    "config": {**READINGS["guided"]["config"], "guidance": "way"},
    # Twice that of "guided": chosen on validation maps (results/study_snn_way_gamma.json).
    "params": {**READINGS["guided"]["params"], "gamma": 3e-4},
}
READINGS["critic"] = {
    **READINGS["way"],
    "config": {**READINGS["way"]["config"], "critic": "td"},
}
# Learning rates relative to that of S4. The additive rule moves a weight by mV and the
# multiplicative one by a fraction, and inputs of S1 and S2 fire at 0.4 times the rate. "tuned":
# best success in testing on Scenarios 1 and 2 (results/study_snn_gamma.json).
GAMMA = {
    "literal": {"S1": 3.0, "S2": 1.0, "S3": 3.0, "S4": 1.0},
    "tuned": {"S1": 27.0, "S2": 9.0, "S3": 3.0, "S4": 1.0},
    "guided": {"S1": 3.0, "S2": 1.0, "S3": 3.0, "S4": 1.0},
    # The best of three on a validation map (results/study_snn_way_gamma.json); S4 of exploration.
    "way": {"S1": 4.0, "S2": 4.0, "S3": 16.0, "S4": 1.0},
}
GAMMA["critic"] = GAMMA["way"]


def preset(
    model: str,
    reading: str = "tuned",
    *,
    config: dict[str, Any] | None = None,
    params: dict[str, Any] | None = None,
    stdp: dict[str, Any] | None = None,
    reward: dict[str, Any] | None = None,
) -> tuple[NetworkConfig, NetworkParams]:
    """Configuration and constants of "S1" to "S4" in a reading of the source, with changes.

    Args:
        model: "S1", "S2", "S3" or "S4".
        reading: "literal", "tuned", "guided", "way" or "critic".
        config, params, stdp, reward: changes of single fields.

    Returns:
        NetworkConfig and NetworkParams.

    Raises:
        ValueError: a name is unknown or a constant is not acceptable.

    Example:
        >>> config, params = preset("S4", "literal")
        >>> params.stdp.anti_causal, params.reward.k
        (1.0, 1.3)
    """
    require_choice("reading", reading, tuple(READINGS))
    base = READINGS[reading]
    built = network_config(model, **{**base["config"], **(config or {})})
    changes = dict(base["params"])
    changes["gamma"] *= GAMMA[reading][model]
    constants = network_params(built, **{**changes, **(params or {})})
    constants = constants._replace(
        stdp=STDPParams(**{**base["stdp"], **(stdp or {})}),
        reward=constants.reward._replace(**{**base["reward"], **(reward or {})}),
    )
    check_network(built, constants)
    return built, constants
