"""Deep lattice network: calibrators, linear embedding, calibrators, lattices.

The chain Cal-Lin-Cal-Lat of the source's Figure 3.4. A path that starts at a monotone input is
monotone in every component that it passes, so the output is monotone in that input, whatever
the weights are.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice import lattice_layer, linear, pwl
from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_signs,
    require_static,
)
from fusion.lattice.lattice_config import LatticeConfig, LatticeParams


class DeepLatticeParams(NamedTuple):
    """Parameters of the four stages; a leading axis of networks can be vmapped over all of them."""

    inputs: pwl.PWLParams
    embedding: linear.LinearParams
    hidden: pwl.PWLParams
    lattices: LatticeParams


@dataclasses.dataclass(frozen=True)
class DeepLatticeConfig:
    """A network from `n_inputs` numbers to one.

    Attributes:
        n_inputs: inputs.
        monotonicity: -1, 0 or +1 for each input: the output is non-increasing in it, free, or
            non-decreasing.
        input_range: `(low, high)` of all inputs, or one pair for each; clipped outside.
        n_keypoints: keypoints of each input calibrator.
        learned_keypoints: learn where the keypoints of the input calibrators are.
        missing_value: inputs equal to this (`nan` is allowed) are missing.
        n_lattices: lattices, whose outputs are averaged.
        embedding_dim: inputs of each lattice, made by the linear embedding.
        n_monotone: how many of these receive the monotone inputs (and then have non-negative
            weights for them, monotone calibrators and monotone lattice axes); the others see the
            free inputs only. `None`: half of them, rounded up, when some inputs are free, else all.
        n_hidden_keypoints: keypoints of the calibrators after the embedding.
        lattice_size: vertices along each lattice axis.
        output_range: `(low, high)` of the output, either of which may be `None`.
        interpolation: of the lattices.
        n_iterations: Dykstra passes for each lattice with several monotone axes.

    Raises:
        ValueError, TypeError: sizes, directions or ranges that mean nothing, by name and value.
    """

    n_inputs: int
    monotonicity: tuple[int, ...] | None = None
    input_range: tuple[float, float] | tuple[tuple[float, float], ...] = (0.0, 1.0)
    n_keypoints: int = 10
    learned_keypoints: bool = False
    missing_value: float | None = None
    n_lattices: int = 1
    embedding_dim: int = 2
    n_monotone: int | None = None
    n_hidden_keypoints: int = 5
    lattice_size: int = 2
    output_range: tuple[float | None, float | None] = (0.0, 1.0)
    interpolation: Literal["hypercube", "simplex"] = "hypercube"
    n_iterations: int = 10

    def __post_init__(self) -> None:
        """Refuse sizes that mean nothing; the stages check the rest."""
        require_static(self)
        for name in ("n_inputs", "n_lattices", "embedding_dim"):
            require_count(name, getattr(self, name))
        require_count("lattice_size", self.lattice_size, 2)
        require_signs("monotonicity", self.monotonicity, self.n_inputs)
        signs = self.signs
        given = self.n_monotone
        if given is not None:
            least = 1 if signs.any() else 0
            most = self.embedding_dim if signs.any() else 0
            if not least <= given <= most:
                raise refusal(
                    "n_monotone",
                    given,
                    f"{least}..{most} of the {self.embedding_dim} embedding outputs for "
                    f"monotonicity {signs.tolist()}",
                    "leave n_monotone out for half of them",
                )
            if given < self.embedding_dim and signs.all():
                raise refusal(
                    "n_monotone",
                    given,
                    f"{self.embedding_dim}, since all inputs are monotone and the other embedding "
                    "outputs would have no input",
                    "leave n_monotone out",
                )
        _ = self.inputs, self.embedding, self.hidden, self.lattice

    @property
    def signs(self) -> np.ndarray:
        """`[n_inputs]` of -1, 0, 1."""
        return np.asarray(self.monotonicity or (0,) * self.n_inputs, np.int64)

    @property
    def axis_signs(self) -> tuple[int, ...]:
        """1 for the monotone axes of each lattice, which come first, 0 for the free ones."""
        signs = self.signs
        count = self.n_monotone
        if count is None:
            free = np.any(signs == 0)
            count = -(-self.embedding_dim // 2) if free else self.embedding_dim
            count = count if signs.any() else 0
        return (1,) * count + (0,) * (self.embedding_dim - count)

    @property
    def inputs(self) -> pwl.PWLConfig:
        """Calibrators of the inputs, to [-1, 1]; a falling one turns a -1 input into a +1."""
        return pwl.PWLConfig(
            self.n_inputs,
            self.n_keypoints,
            input_range=self.input_range,
            monotonicity=tuple(int(s) for s in self.signs),
            output_range=(-1.0, 1.0),
            learned_keypoints=self.learned_keypoints,
            missing_value=self.missing_value,
        )

    @property
    def embedding(self) -> linear.LinearConfig:
        """Linear embedding; with magnitudes that sum to 1 it stays in [-1, 1]."""
        rows = self.axis_signs * self.n_lattices
        monotone = [int(s != 0) for s in self.signs]
        connected = tuple(
            tuple(1 if row or not m else 0 for m in monotone) for row in rows
        )  # fmt: skip
        return linear.LinearConfig(
            self.n_inputs,
            len(rows),
            monotonicity=tuple(tuple(row * m for m in monotone) for row in rows),
            normalized=True,
            connected=None if all(rows) or not any(monotone) else connected,
        )

    @property
    def hidden(self) -> pwl.PWLConfig:
        """Calibrators of the embedding, to the range of a lattice axis."""
        return pwl.PWLConfig(
            self.n_lattices * self.embedding_dim,
            self.n_hidden_keypoints,
            input_range=(-1.0, 1.0),
            monotonicity=self.axis_signs * self.n_lattices,
            output_range=(0.0, self.lattice_size - 1.0),
        )

    @property
    def lattice(self) -> LatticeConfig:
        """Each of the lattices."""
        return LatticeConfig(
            (self.lattice_size,) * self.embedding_dim,
            monotonicity=self.axis_signs,
            output_range=self.output_range,
            interpolation=self.interpolation,
            n_iterations=self.n_iterations,
        )


def init(key: Key[Array, ""], config: DeepLatticeConfig) -> DeepLatticeParams:
    """Straight calibrators, a random embedding, planes as lattices.

    Args:
        key: PRNG key. For K networks: `jax.vmap(init, (0, None))` with K keys.
        config: the network.

    Returns:
        DeepLatticeParams; feasible.

    Example:
        >>> config = DeepLatticeConfig(3, monotonicity=(-1, 0, 0), input_range=(0.0, 4.0))
        >>> params = jax.jit(init, static_argnums=1)(jax.random.key(0), config)
        >>> x = jnp.array([[0.5, 1.0, 1.0], [3.0, 1.0, 1.0]])
        >>> y = jax.jit(apply, static_argnums=0)(config, params, x)
        >>> bool(y[1] < y[0])
        True
    """
    require_key(key)
    keys = jax.random.split(key, 4)
    return DeepLatticeParams(
        pwl.init(keys[0], config.inputs),
        linear.init(keys[1], config.embedding),
        pwl.init(keys[2], config.hidden),
        jax.vmap(lambda k: lattice_layer.init(k, config.lattice))(
            jax.random.split(keys[3], config.n_lattices)
        ),
    )


def apply(
    config: DeepLatticeConfig, params: DeepLatticeParams, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch"]:
    r"""The network's output.

    .. math:: f(x) = \frac{1}{L} \sum_{l=1}^{L} \mathrm{lattice}_l\big(c'_l(W_l\, c(x))\big)

    Symbols: :math:`c` are the `inputs` calibrators; :math:`W` is the `embedding`; :math:`c'` are
    the `hidden` calibrators; :math:`L` is `n_lattices`.

    Args:
        config: of the network.
        params: of the network.
        x: inputs.

    Returns:
        One number for each example, within `output_range`.

    Source: You et al. (2017), Deep lattice networks and partial monotonic functions; the layout
    of the dissertation's Figure 3.4.
    """
    h = pwl.apply(config.inputs, params.inputs, x)
    h = linear.apply(config.embedding, params.embedding, h)
    h = pwl.apply(config.hidden, params.hidden, h)
    h = h.reshape(*x.shape[:-1], config.n_lattices, config.embedding_dim)
    lattice = config.lattice
    if config.n_lattices == 1:
        only = jax.tree.map(lambda a: a[0], params.lattices)
        return lattice_layer.apply(lattice, only, h[..., 0, :])
    outputs = jax.vmap(lambda p, z: lattice_layer.apply(lattice, p, z), (0, -2), -1)(
        params.lattices, h
    )
    return jnp.mean(outputs, axis=-1)


def project(config: DeepLatticeConfig, params: DeepLatticeParams) -> DeepLatticeParams:
    """Each stage projected onto its own constraints, which together make the network monotone.

    Args:
        config: of the network.
        params: of the network. For K networks: `jax.vmap(project, (None, 0))`.

    Returns:
        DeepLatticeParams with `check(...) == 0`.
    """
    lattice = config.lattice
    return DeepLatticeParams(
        pwl.project(config.inputs, params.inputs),
        linear.project(config.embedding, params.embedding),
        pwl.project(config.hidden, params.hidden),
        jax.vmap(lambda p: lattice_layer.project(lattice, p))(params.lattices),
    )


def check(config: DeepLatticeConfig, params: DeepLatticeParams) -> Float[Array, ""]:
    """Largest violation in any stage; 0 where the network is monotone and bounded as asked."""
    lattices = jax.vmap(lambda p: lattice_layer.check(config.lattice, p))(params.lattices)
    return jnp.maximum(
        jnp.maximum(
            pwl.check(config.inputs, params.inputs),
            linear.check(config.embedding, params.embedding),
        ),
        jnp.maximum(pwl.check(config.hidden, params.hidden), jnp.max(lattices)),
    )
