"""What PPO needs from outside: the environment as two functions, sizes and constants."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from jaxsnn._checks import concrete, require, require_positive, require_whole


class Transition(NamedTuple):
    """What an environment answers to an action."""

    state: Any
    obs: Array  # [o]
    reward: Array  # []
    terminated: Array  # [] bool: the task is over, nothing follows
    truncated: Array  # [] bool: out of steps, the value of what follows still counts
    success: Array  # [] bool


class Env(NamedTuple):
    """An environment as two pure functions."""

    reset: Callable[[Array], tuple[Any, Array]]  # key -> (state, obs)
    step: Callable[[Any, Array], Transition]  # (state, action [a]) -> Transition
    action_size: int


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Sizes and choices; static: a change compiles anew.

    Attributes:
        n_envs: robots that act at the same time.
        n_steps: control steps of each of them per update.
        n_updates, n_epochs, n_minibatches: updates; passes over the data of each, in minibatches.
        anneal: let the learning rate fall to 0 over the training.
        hidden: width of the layers of both networks.
        initial_std: deviation of the action at the start.
    """

    n_envs: int = 8
    n_steps: int = 64
    n_updates: int = 150
    n_epochs: int = 4
    n_minibatches: int = 4
    anneal: bool = True
    hidden: tuple[int, ...] = (64, 64)
    initial_std: float = 0.6

    def __post_init__(self) -> None:
        """Refuse sizes that do not fit together."""
        for name in ("n_envs", "n_steps", "n_updates", "n_epochs", "n_minibatches"):
            require_whole(name, getattr(self, name), 1, "give at least one")
        for width in self.hidden:
            require_whole("hidden", width, 1, "give widths of layers")
        require_positive("initial_std", self.initial_std, "0.6 is the default")
        total = self.n_envs * self.n_steps
        require(
            total % self.n_minibatches == 0,
            f"n_minibatches={self.n_minibatches}: expected a divisor of n_envs * n_steps = {total} "
            "transitions; change one of them",
        )


class PPOParams(NamedTuple):
    """Constants of the learner; leaves are floats that may be traced, so a sweep compiles once.

    Attributes:
        learning_rate: of Adam.
        discount: `gamma`.
        gae_lambda: `lambda` of the advantage estimates.
        clip: largest change of the policy's ratio that still counts.
        value_coef, entropy_coef: weights in the loss.
        max_grad_norm: norm to which a gradient is cut.
    """

    learning_rate: float | Float[Array, ""] = 1e-3
    discount: float | Float[Array, ""] = 0.98
    gae_lambda: float | Float[Array, ""] = 0.95
    clip: float | Float[Array, ""] = 0.2
    value_coef: float | Float[Array, ""] = 0.5
    entropy_coef: float | Float[Array, ""] = 0.0
    max_grad_norm: float | Float[Array, ""] = 0.5


def check_ppo(params: PPOParams) -> None:
    """Refuse constants with which nothing is learnt; traced values pass.

    Raises:
        ValueError: names the constant, its value and the fix.
    """
    for name in ("learning_rate", "clip", "max_grad_norm"):
        require_positive(name, getattr(params, name), "the default is a good start")
    for name in ("value_coef", "entropy_coef"):
        require_positive(name, getattr(params, name), "0 leaves the term out", zero=True)
    for name in ("discount", "gae_lambda"):
        require_positive(name, getattr(params, name), "give a number in [0, 1]", zero=True)
        value = concrete(getattr(params, name))
        if value is not None:
            require(
                bool((value <= 1.0).all()),
                f"{name}={value.max():g}: expected a number in [0, 1]; lower it",
            )
