"""Robots under gymnasium: its own checker, seeds, and many robots against one by one."""

from __future__ import annotations

import numpy as np
import pytest

from jaxsnn import scenarios

pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env

from jaxsnn.gym_env import RobotEnv, RobotVectorEnv


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_s_checker_finds_nothing():
    check_env(RobotEnv(scenarios.scenario(1)), skip_render_check=True)


def test_the_same_seed_gives_the_same_episode_and_it_is_cut_off():
    env = RobotEnv(scenarios.scenario(3), max_steps=4)
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, again)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]


def test_many_robots_begin_anew_in_the_step_after_their_end():
    env = RobotVectorEnv(scenarios.scenario(1), 3, max_steps=2)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (3, 8) and env.observation_space.contains(obs)
    actions = np.zeros((3, 1), np.float32)
    rows = [env.step(actions) for _ in range(4)]
    assert [r[3].tolist() for r in rows] == [[False] * 3, [True] * 3, [False] * 3, [False] * 3]
    assert rows[2][1].tolist() == [0.0] * 3  # the step of the fresh start
    assert all(r[1].shape == (3,) for r in rows)
