"""Layers as `flax.linen` modules, whose parameters carry their configuration.

Each module takes the `Config` of its layer. `project_tree(variables["params"])` and
`with_projection(optimizer)` find the layers wherever they are in a model, also under `nn.vmap`,
`nn.scan`, `nn.remat` and inside masked or partitioned optimizers.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fusion.lattice import aggregation, categorical, cdf, deep_lattice, ensemble, kronecker, pwl
from fusion.lattice import linear as linear_layer
from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.tagged import init_tagged, layer_of


class _Layer(nn.Module):
    """What all layers share: a tagged parameter `layer`, and `apply` of its functions."""

    def _apply(self, config: Any, x: Array, dtype: Any) -> Array:
        params = self.param("layer", init_tagged, config, dtype)
        return layer_of(config).apply(config, params, x)


class PWLCalibration(_Layer):
    """Piecewise-linear calibrators `[..., n_inputs] -> [..., n_inputs]`.

    Attributes:
        config: of the layer.
        param_dtype: type of the parameters.
    """

    config: pwl.PWLConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch n_inputs"]:
        """Each input through its own calibrator."""
        return self._apply(self.config, x, self.param_dtype)


class CategoricalCalibration(_Layer):
    """Calibrator of one categorical input, `[...] -> [...]`; attributes as in `PWLCalibration`."""

    config: categorical.CategoricalConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The output of each category."""
        return self._apply(self.config, x, self.param_dtype)


class Linear(_Layer):
    """Constrained linear layer `[..., n_inputs] -> [..., n_outputs]`."""

    config: linear_layer.LinearConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch n_outputs"]:
        """Weighted sums of the inputs."""
        return self._apply(self.config, x, self.param_dtype)


class Lattice(_Layer):
    """One lattice `[..., rank] -> [...]`."""

    config: LatticeConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch rank"]) -> Float[Array, "*batch"]:
        """The interpolated output."""
        return self._apply(self.config, x, self.param_dtype)


class Ensemble(_Layer):
    """Mean of lattices over subsets of the inputs, `[..., n_inputs] -> [...]`."""

    config: ensemble.EnsembleConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch"]:
        """The mean of the lattices' outputs."""
        return self._apply(self.config, x, self.param_dtype)


class DeepLattice(_Layer):
    """Calibrators, linear embedding, calibrators, lattices, `[..., n_inputs] -> [...]`."""

    config: deep_lattice.DeepLatticeConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch"]:
        """The network's output."""
        return self._apply(self.config, x, self.param_dtype)


class KroneckerLattice(_Layer):
    """Sum of products of curves, `[..., n_inputs] -> [...]`."""

    config: kronecker.KroneckerConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch"]:
        """The output."""
        return self._apply(self.config, x, self.param_dtype)


class CDF(_Layer):
    """Rising functions of soft steps, `[..., n_inputs] -> [..., n_outputs]`."""

    config: cdf.CDFConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n_inputs"]) -> Float[Array, "*batch n_outputs"]:
        """Outputs in [0, 1]."""
        return self._apply(self.config, x, self.param_dtype)


class Aggregation(_Layer):
    """Function of a set of items, `[..., n_items, n_features]` and a mask `-> [...]`."""

    config: aggregation.AggregationConfig
    param_dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "*items n_features"],
        mask: Bool[Array, "..."] | None = None,
        *,
        segment_ids: Int[Array, "..."] | None = None,
        n_examples: int | None = None,
    ) -> Float[Array, "..."]:
        """The output of each set, given by a mask or by the number of the example of each row.

        Raises:
            ValueError: neither `mask` nor both of `segment_ids` and `n_examples`, or all of them.
        """
        params: Any = self.param("layer", init_tagged, self.config, self.param_dtype)
        return aggregation.apply_either(self.config, params, x, mask, segment_ids, n_examples)
