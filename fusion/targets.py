"""Learned fusion-weight targets: K monotone lattice networks from auxiliary losses to targets."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion._checks import check_key
from fusion.lattice import deep_lattice
from fusion.lattice.checks import refusal, require_count, require_range
from fusion.lattice.deep_lattice import DeepLatticeConfig, DeepLatticeParams


@dataclasses.dataclass(frozen=True)
class TargetConfig:
    """Sizes of the networks f_k of Equation 3.2 (the source states none; see docs/argate.md).

    Attributes:
        n_keypoints: keypoints of the calibrator of each loss.
        loss_range: losses covered by the keypoints, in nats; clipped outside.
        n_hidden_keypoints: keypoints of the calibrators after the linear embedding.
        lattice_size: vertices along each of the two axes of the lattice.
    """

    n_keypoints: int = 8
    loss_range: tuple[float, float] = (0.0, 4.0)
    n_hidden_keypoints: int = 4
    lattice_size: int = 3

    def __post_init__(self) -> None:
        """Refuse sizes and ranges that mean nothing."""
        for name in ("n_keypoints", "n_hidden_keypoints", "lattice_size"):
            require_count(name, getattr(self, name), 2)
        require_range("loss_range", self.loss_range)
        if None in self.loss_range:
            raise refusal(
                "loss_range", self.loss_range, "two numbers", "give the smallest and largest loss"
            )


def lattice_config(config: TargetConfig, n_sensors: int) -> DeepLatticeConfig:
    """The calibrator-linear-calibrator-lattice chain of one f_k; its own loss is input 0.

    Two embedding outputs: one carries the own loss and is monotone, one carries the others.
    """
    return DeepLatticeConfig(
        n_inputs=n_sensors,
        monotonicity=(-1, *(0,) * (n_sensors - 1)),
        input_range=config.loss_range,
        n_keypoints=config.n_keypoints,
        embedding_dim=2 if n_sensors > 1 else 1,
        n_hidden_keypoints=config.n_hidden_keypoints,
        lattice_size=config.lattice_size,
        output_range=(0.0, 1.0),
    )


def _own_first(n_sensors: int) -> np.ndarray:
    """Row k lists the inputs of f_k: k itself, then the others in order."""
    rows = [[k, *(j for j in range(n_sensors) if j != k)] for k in range(n_sensors)]
    return np.asarray(rows)


def init_targets(key: Key[Array, ""], config: TargetConfig, n_sensors: int) -> DeepLatticeParams:
    """Parameters of the K networks, stacked on a leading axis."""
    check_key(key)
    keys = jax.random.split(key, n_sensors)
    return jax.vmap(deep_lattice.init, (0, None))(keys, lattice_config(config, n_sensors))


def apply_targets(
    config: TargetConfig, params: DeepLatticeParams, losses: Float[Array, "b k"]
) -> Float[Array, "b k"]:
    r"""Fusion-weight targets of each example.

    .. math:: t_k = f_k(L_k, L_{j \neq k}), \qquad \partial f_k / \partial L_k \leq 0

    Args:
        config: static.
        params: of the K networks.
        losses: cross entropy of each auxiliary path, per example.

    Returns:
        Targets in [0, 1]; they need not sum to one, as in Equation 3.2.

    Source: Shim (2020), Eq. 3.2 and Figure 3.4; two embedding outputs and one lattice
    as the source uses for KITTI.
    """
    k = losses.shape[-1]
    inputs = jnp.transpose(losses[:, _own_first(k)], (1, 0, 2))
    apply = jax.vmap(deep_lattice.apply, (None, 0, 0))
    return apply(lattice_config(config, k), params, inputs).T


def project_targets(config: TargetConfig, params: DeepLatticeParams) -> DeepLatticeParams:
    """The nearest parameters (stage by stage) with which every f_k is monotone and bounded."""
    k = params.lattices[0].shape[0]
    return jax.vmap(deep_lattice.project, (None, 0))(lattice_config(config, k), params)


def check_targets(config: TargetConfig, params: DeepLatticeParams) -> Float[Array, ""]:
    """Largest violation of a constraint in any f_k; 0 after `project_targets`."""
    k = params.lattices[0].shape[0]
    check = jax.vmap(deep_lattice.check, (None, 0))
    return jnp.max(check(lattice_config(config, k), params))
