"""The numeric functions of `jaxsnn` under jit, vmap, scan and grad: one table."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import (
    agents,
    config,
    drivers,
    encoding,
    experiment,
    geometry,
    navigation,
    network,
    neurons,
    plasticity,
    ppo,
    qlearning,
    rewards,
    running_mean,
    scenarios,
    sensor_intervals,
    window,
    world,
)
from tests._api import Case, check

DT = 1e-3
PLACE = scenarios.scenario(1)
SMALL = config.network_config(
    "S4", group_exc=1, group_inh=1, hidden_exc=4, hidden_inh=4, control_steps=4, hold_steps=4
)
CONSTANTS = jax.tree.map(jnp.float32, config.network_params(SMALL))
PAIRS = plasticity.STDPParams()
TABLE = encoding.rate_table("proposed")
SPIKES = "spikes are thresholds"


def f32(*values: Any) -> tuple:
    return tuple(np.asarray(v, np.float32) for v in values)


def leaves(params: Any) -> Any:
    return jax.tree.map(np.float32, params)


def spikes(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.random(shape) < 0.3).astype(np.float32)


def key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))


def lif(rng: np.random.Generator) -> tuple:
    state = neurons.LIFState(*f32(rng.uniform(0, 20, 4), rng.choice([0.0, 1e-3], 4)))
    return leaves(neurons.LIFParams()), state, *f32(rng.uniform(0, 5, 4))


def traces(rng: np.random.Generator) -> plasticity.STDPState:
    return plasticity.STDPState(
        plasticity.Traces(*f32(rng.random(3), -rng.random(2))), *f32(rng.normal(size=(3, 2)))
    )


def stdp(rng: np.random.Generator) -> tuple:
    params = leaves(plasticity.STDPParams())
    return params, traces(rng), spikes(rng, 5, 3), spikes(rng, 5, 2)


def weights(rng: np.random.Generator) -> tuple:
    return f32(rng.uniform(0.5, 4.5, 6), 0.05 * rng.normal(size=6))


def reward(rng: np.random.Generator) -> tuple:
    return leaves(rewards.RewardParams(goal_angle=60.0)), *f32(rng.uniform(10, 90))


def sight(rng: np.random.Generator) -> tuple:
    readings = f32(rng.uniform(20, 250, 5), rng.uniform(20, 190), rng.choice([-90.0, 90.0]))
    return leaves(rewards.RewardParams(goal_angle=60.0)), *readings


def ray(rng: np.random.Generator) -> tuple:
    angle = rng.uniform(0, 6.28)
    return f32(rng.uniform(-5, 5, 2), [np.cos(angle), np.sin(angle)])


def segments(rng: np.random.Generator) -> tuple:
    corners = 40.0 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) + rng.uniform(-5, 5, (4, 2))
    return f32(np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1))


def pose(rng: np.random.Generator) -> tuple:
    return f32(rng.uniform(60, 120), rng.uniform(60, 120), rng.uniform(-3, 3))


def robot(x: Any, y: Any, heading: Any) -> world.WorldState:
    return world.WorldState(x, y, heading, jnp.zeros((), jnp.int32), jax.random.key(0))


def crowd(rng: np.random.Generator) -> tuple:
    return f32(*rng.uniform(60, 300, (2, 3)), rng.uniform(-3, 3, 3), rng.uniform(-40, 40, 3))


def robots(x: Any, y: Any, heading: Any) -> world.WorldState:
    return world.WorldState(
        x, y, heading, jnp.zeros(3, jnp.int32), jax.random.split(jax.random.key(0), 3)
    )


def brain(rng: np.random.Generator) -> network.NetworkState:
    return _brain(key(rng))


_brain = jax.jit(lambda k: network.init(k, SMALL, CONSTANTS))


def held(rng: np.random.Generator) -> network.Eligibility:
    shapes = ((SMALL.n_in, SMALL.n_hidden), (2, SMALL.n_half), (SMALL.n_hidden,), (2,), ())
    return network.Eligibility(*f32(*(rng.random(shape) for shape in shapes)))


def travel(x: Any, y: Any, heading: Any, steering: Any) -> jax.Array:
    before = robot(x, y, heading)
    after, outcome = world.step(PLACE, before, steering)
    return navigation.navigation_reward(PLACE, before, after, outcome)


CASES = [
    Case("neurons.lif_step", lambda p, s, j: neurons.lif_step(p, s, 0.5, j, dt=DT), lif, (0, 2)),
    Case(
        "neurons.lif_scan",
        lambda p, s, j: neurons.lif_scan(p, s, j, dt=DT),
        lambda rng: (*lif(rng)[:2], *f32(rng.uniform(0, 6, (5, 4)))),
        (0, 2),
    ),
    Case(
        "plasticity.stdp_step",
        lambda p, s, pre, post: plasticity.stdp_step(p, s, pre[0], post[0], dt=DT),
        stdp,
    ),
    Case(
        "plasticity.stdp_curve",
        plasticity.stdp_curve,
        lambda rng: (stdp(rng)[0], *f32(rng.uniform(1e-3, 0.1, 4) * [1, -1, 1, -1])),
        (0, 1),
    ),
    *(
        Case(
            f"plasticity.apply_reward ({rule}, {bounds})",
            lambda w, d, rule=rule, bounds=bounds: plasticity.apply_reward(
                w, d, 0.0, 5.0, rule=rule, bounds=bounds
            ),
            weights,
            (0, 1),
        )
        for rule in ("additive", "multiplicative")
        for bounds in ("hard", "soft")
    ),
    Case(
        "window.stdp_kernel",
        lambda p: window.stdp_kernel(p, 5, dt=DT),
        lambda rng: (jax.tree.map(lambda v: np.float32(v * rng.uniform(0.9, 1.1)), PAIRS),),
    ),
    Case(
        "window.stdp_window",
        lambda p, s, pre, post: window.stdp_window(window.stdp_kernel(p, 5, dt=DT), s, pre, post),
        stdp,
        (0, 1),
    ),
    Case(
        "window.stdp_steps",
        lambda p, s, pre, post: window.stdp_steps(p, s, pre, post, dt=DT),
        stdp,
    ),
    *(
        Case(
            f"sensor_intervals.{name}",
            getattr(sensor_intervals, name),
            lambda rng, low=low, high=high: f32(rng.uniform(low, high, 4)),
            (),
            "gives integers",
        )
        for name, low, high in (
            ("sonar_interval", 0, 300),
            ("distance_interval", 0, 800),
            ("angle_region", -180, 180),
        )
    ),
    Case(
        "encoding.group_rates",
        encoding.group_rates,
        lambda rng: (leaves(TABLE), *sight(rng)[1:]),
    ),
    Case(
        "encoding.poisson_spikes",
        lambda k, rates: encoding.poisson_spikes(rates, 6, key=k, dt=DT),
        lambda rng: (key(rng), *f32(rng.uniform(0, 500, 3))),
        (),
        SPIKES,
    ),
    Case(
        "rewards.avoidance_rewards",
        lambda p, d: rewards.avoidance_rewards(p, d)[..., 0],
        reward,
        (0, 1),
    ),
    Case("rewards.target_reward", rewards.target_reward, reward, (0, 1)),
    Case(
        "rewards.motor_rewards",
        lambda p, s, d, a: rewards.motor_rewards(p, s, d, a)[0],
        sight,
        (0, 2),
    ),
    Case(
        "rewards.scale_by_remaining_turn",
        rewards.scale_by_remaining_turn,
        lambda rng: (sight(rng)[0], *f32(rng.normal(size=2), rng.uniform(-50, 50))),
        (0, 1, 2),
    ),
    Case(
        "rewards.terminal_reward",
        rewards.terminal_reward,
        lambda rng: (reward(rng)[0], np.bool_(rng.random() < 0.5), np.bool_(True)),
    ),
    Case(
        "rewards.synapse_signs",
        rewards.synapse_signs,
        lambda rng: f32(rng.choice([-1.0, 1.0], 3), rng.choice([-1.0, 1.0], 2)),
        (0, 1),
    ),
    Case(
        "geometry.ray_segments",
        geometry.ray_segments,
        lambda rng: (*ray(rng), *segments(rng)),
        (0, 2),
        misses=True,
    ),
    Case(
        "geometry.ray_circles",
        geometry.ray_circles,
        lambda rng: (*ray(rng), *f32([[0.0, 0.0, 30.0], [60.0, 0.0, 20.0]])),
        (0, 2),
        misses=True,
    ),
    Case(
        "geometry.ray_box",
        geometry.ray_box,
        lambda rng: (*ray(rng), *f32([-50.0, -40.0, 50.0, 40.0])),
        (0, 2),
    ),
    Case(
        "geometry.disc_circle_contact",
        geometry.disc_circle_contact,
        lambda rng: f32(
            rng.uniform(-2, 2, 2), [[60.0, 1.0], [1.0, 60.0]], 40.0 * np.eye(2), [10.0, 12.0]
        ),
        (0, 2),
        misses=True,
    ),
    Case(
        "geometry.disc_segment_contact",
        geometry.disc_segment_contact,
        lambda rng: (*f32(rng.uniform(-2, 2, 2), rng.uniform(50, 80, (4, 2)), 6.0), *segments(rng)),
        (0, 3),
        misses=True,
    ),
    Case(
        "geometry.disc_box_contact",
        geometry.disc_box_contact,
        lambda rng: f32(
            rng.uniform(-2, 2, 2), rng.uniform(50, 80, 2), 6.0, [-50.0, -40.0, 50.0, 40.0]
        ),
        (0, 3),
        misses=True,
    ),
    Case(
        "world.obstacles_at",
        lambda t: world.obstacles_at(PLACE, t),
        lambda rng: (np.int32(rng.integers(9)),),
        (),
        "of whole steps",
    ),
    Case("world.reset", lambda k: world.reset(PLACE, key=k), lambda rng: (key(rng),), (), "a draw"),
    Case("world.observe", lambda x, y, h: world.observe(PLACE, robot(x, y, h)), pose, (0, 1, 2)),
    Case(
        "world.step",
        lambda x, y, h, a: world.step(PLACE, robot(x, y, h), a)[0][:3],
        lambda rng: (*pose(rng), *f32(rng.uniform(-40, 40))),
        (0, 1, 2, 3),
    ),
    Case(
        "world.observe_many",
        lambda x, y, h, a: world.observe_many(PLACE, robots(x, y, h), active=a > -20.0),
        crowd,
        (0, 1, 2),
    ),
    Case(
        "world.step_many",
        lambda x, y, h, a: world.step_many(PLACE, robots(x, y, h), a, active=a > -20.0)[0][:3],
        crowd,
        (0, 1, 2, 3),
    ),
    Case(
        "running_mean.baseline_update",
        lambda m, s: running_mean.baseline_update(m, s, tau=1.0, duration=0.1),
        lambda rng: (running_mean.Baseline(*f32(rng.random(3), 0.4)), spikes(rng, 3)),
        (0, 1),
    ),
    Case(
        "agents.steering_angle",
        lambda r: agents.steering_angle(CONSTANTS, r),
        lambda rng: f32(rng.uniform(0, 90, 2)),
    ),
    Case(
        "network_state.init",
        lambda k: network.init(k, SMALL, CONSTANTS),
        lambda rng: (key(rng),),
        (),
        "a draw",
    ),
    Case(
        "network.step",
        lambda s, pre, r: network.step(SMALL, CONSTANTS, s, pre, r),
        lambda rng: (brain(rng), spikes(rng, SMALL.n_in), *f32(rng.normal(size=2))),
        (0,),
    ),
    Case(
        "network.window",
        lambda s, pre: network.window(SMALL, CONSTANTS, network.kernel(SMALL, CONSTANTS), s, pre),
        lambda rng: (brain(rng), spikes(rng, 4, SMALL.n_in)),
        (0,),
    ),
    Case(
        "network.fire",
        lambda s, pre: network.fire(SMALL, CONSTANTS, s, pre),
        lambda rng: (brain(rng), spikes(rng, 4, SMALL.n_in)),
        (0,),
    ),
    Case(
        "network_state.reset_membranes",
        lambda s, fresh: network.reset_membranes(CONSTANTS, s, fresh),
        lambda rng: (brain(rng), np.bool_(rng.random() < 0.5)),
    ),
    Case(
        "reinforcement.reinforce",
        lambda w, e, r: network.reinforce(SMALL, CONSTANTS, w, e, r),
        lambda rng: (brain(rng).weights, held(rng), *f32(rng.normal(size=2))),
        (0, 2),
    ),
    Case(
        "qlearning.discretize",
        lambda x, y, h: qlearning.discretize(world.observe(PLACE, robot(x, y, h))),
        pose,
        (),
        "gives integers",
    ),
    Case(
        "qlearning.td_target",
        qlearning.td_target,
        lambda rng: (
            leaves(qlearning.QParams()),
            *f32(rng.normal()),
            np.bool_(False),
            *f32(rng.normal(size=3)),
        ),
        (1, 3),
    ),
    Case(
        "navigation.observation",
        lambda x, y, h: navigation.observation(PLACE, world.observe(PLACE, robot(x, y, h))),
        pose,
        (0, 1, 2),
    ),
    Case(
        "drivers.driver_steering",
        lambda p, s, d, a: drivers.driver_steering(p, world.Reading(s, d, a)),
        lambda rng: (leaves(drivers.DRIVERS["reflex_60"]), *sight(rng)[1:3], *f32(20.0)),
        (0, 3),
    ),
    Case(
        "navigation.start_robot",
        lambda k: navigation.start_robot(PLACE, key=k),
        lambda rng: (key(rng),),
        (),
        "a draw",
    ),
    Case(
        "navigation.drive_robot",
        lambda x, y, h, a: navigation.drive_robot(PLACE, robot(x, y, h), a)[1:3],
        lambda rng: (*pose(rng), *f32(rng.uniform(-0.9, 0.9, 1))),
        (0, 1, 2, 3),
    ),
    Case(
        "experiment.seed_keys",
        experiment.seed_keys,
        lambda rng: (np.int32(rng.integers(100, size=3)),),
        (),
        "makes keys",
    ),
    Case(
        "navigation.navigation_reward",
        travel,
        lambda rng: (*pose(rng), *f32(rng.uniform(-40, 40))),
        (0, 1, 2, 3),
    ),
    Case(
        "ppo.gae",
        lambda r, v, n, t: ppo.gae(r, v, n, t, t, discount=0.9, gae_lambda=0.8),
        lambda rng: (*f32(*rng.normal(size=(3, 5))), rng.random(5) < 0.2),
        (0, 1, 2),
    ),
    Case(
        "experiment.phase_keys", experiment.phase_keys, lambda rng: (key(rng),), (), "splits a key"
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_jit_once_vmap_is_scan_and_slopes_are_finite(case: Case) -> None:
    check(case)
