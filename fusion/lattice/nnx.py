"""Layers as `flax.nnx` modules, the twins of `fusion.lattice.linen`, and their projection.

`nnx.Optimizer` hands plain arrays to optax, without the variables that hold them. So the projection
is read off the model: `with_projection(optax.adam(1e-2), projection(model))`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Shaped

from fusion.lattice import aggregation
from fusion.lattice.categorical import CategoricalConfig
from fusion.lattice.cdf import CDFConfig
from fusion.lattice.checks import refusal
from fusion.lattice.deep_lattice import DeepLatticeConfig
from fusion.lattice.ensemble import EnsembleConfig
from fusion.lattice.kronecker import KroneckerConfig
from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.linear import LinearConfig
from fusion.lattice.pwl import PWLConfig
from fusion.lattice.tagged import init_tagged, layer_of


def _named(params: Any) -> dict[str, Any]:
    """The arrays of a layer by flat names, such as `embedding_weights`."""
    return {
        "_".join(str(getattr(entry, "name", getattr(entry, "idx", ""))) for entry in path): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(params)
    }


class _Layer(nnx.Module):
    """One `nnx.Param` for each array of the layer's parameters."""

    def __init__(self, config: Any, *, rngs: nnx.Rngs, param_dtype: Any = jnp.float32) -> None:
        self.config = config
        params = init_tagged(rngs.params(), config, param_dtype).value
        for name, leaf in _named(params).items():
            setattr(self, name, nnx.Param(leaf))
        self.names = tuple(_named(params))
        self.structure = jax.tree.structure(params)

    @property
    def params(self) -> Any:
        """The parameters as the functions of the layer take them."""
        leaves = [getattr(self, name).get_value() for name in self.names]
        return jax.tree.unflatten(self.structure, leaves)

    def __call__(self, x: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
        """The layer's output; see the `linen` module of the same name."""
        return layer_of(self.config).apply(self.config, self.params, x)


class PWLCalibration(_Layer):
    """Piecewise-linear calibrators `[..., n_inputs] -> [..., n_inputs]`."""

    config: PWLConfig


class CategoricalCalibration(_Layer):
    """Calibrator of one categorical input, `[...] -> [...]`."""

    config: CategoricalConfig


class Linear(_Layer):
    """Constrained linear layer `[..., n_inputs] -> [..., n_outputs]`."""

    config: LinearConfig


class Lattice(_Layer):
    """One lattice `[..., rank] -> [...]`."""

    config: LatticeConfig


class Ensemble(_Layer):
    """Mean of lattices over subsets of the inputs, `[..., n_inputs] -> [...]`."""

    config: EnsembleConfig


class DeepLattice(_Layer):
    """Calibrators, linear embedding, calibrators, lattices, `[..., n_inputs] -> [...]`."""

    config: DeepLatticeConfig


class KroneckerLattice(_Layer):
    """Sum of products of curves, `[..., n_inputs] -> [...]`."""

    config: KroneckerConfig


class CDF(_Layer):
    """Rising functions of soft steps, `[..., n_inputs] -> [..., n_outputs]`."""

    config: CDFConfig


class Aggregation(_Layer):
    """Function of a set of items; see the `linen` module of the same name."""

    config: aggregation.AggregationConfig

    def __call__(
        self,
        x: Float[Array, "*items n_features"],
        mask: Bool[Array, "..."] | None = None,
        *,
        segment_ids: Int[Array, "..."] | None = None,
        n_examples: int | None = None,
    ) -> Float[Array, "..."]:
        """The output of each set."""
        return aggregation.apply_either(self.config, self.params, x, mask, segment_ids, n_examples)


def _layers(model: nnx.Module) -> list[tuple[tuple[Any, ...], _Layer]]:
    found = [(path, m) for path, m in nnx.iter_modules(model) if isinstance(m, _Layer)]
    if not found:
        raise refusal(
            "model", type(model).__name__, "a model with a layer of fusion.lattice.nnx",
            "use optax without a projection",
        )  # fmt: skip
    return found


def projection(model: nnx.Module) -> Callable[[Any], Any]:
    """What `with_projection` needs to project every lattice layer of a model.

    Args:
        model: holds layers of this module at any depth.

    Returns:
        A function from the arrays of the model, as `nnx.Optimizer` passes them, to the same with
        every layer on its constraints. Layers that an optax mask hides are left alone.

    Raises:
        ValueError: the model holds no such layer.

    Example:
        >>> curve = PWLCalibration(PWLConfig(1, 3, monotonicity=1), rngs=nnx.Rngs(0))
        >>> arrays = nnx.to_pure_dict(nnx.state(curve, nnx.Param))
        >>> arrays["outputs"] = jnp.array([[0.0, 2.0, 1.0]])
        >>> projection(curve)(arrays)["outputs"].tolist()
        [[0.0, 1.5, 1.5]]
    """
    layers = [(path, m.config, m.names, m.structure) for path, m in _layers(model)]

    def project(params: Any) -> Any:
        params = jax.tree.map(lambda a: a, params, is_leaf=_is_masked)
        for path, config, names, structure in layers:
            place = params
            for key in path:
                place = place[key]
            leaves = [place[name] for name in names]
            if any(_is_masked(leaf) for leaf in leaves):
                continue
            moved = layer_of(config).project(config, jax.tree.unflatten(structure, leaves))
            for name, leaf in _named(moved).items():
                place[name] = leaf
        return params

    return project


def _is_masked(node: Any) -> bool:
    return isinstance(node, optax.MaskedNode)


def check_model(model: nnx.Module) -> Float[Array, ""]:
    """Largest violation in any lattice layer of a model; 0 where all constraints hold.

    Raises:
        ValueError: the model holds no such layer.
    """
    found = [layer_of(m.config).check(m.config, m.params) for _, m in _layers(model)]
    return jnp.max(jnp.stack(found))
