"""Parameters that carry their configuration, so that they are found and projected in any tree.

A `Tagged` node holds the parameters of one layer as leaves and its configuration as static data.
Gradients, optimizer states and masked copies of a tree keep the node, since it is part of the
tree's structure: `project_tree` needs no path, inside flax, optax or plain dictionaries.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from flax.core import meta
from jaxtyping import Array, Float

from fusion.lattice import (
    aggregation,
    categorical,
    cdf,
    deep_lattice,
    ensemble,
    kronecker,
    lattice_layer,
    linear,
    premade,
    pwl,
)
from fusion.lattice.checks import refusal
from fusion.lattice.lattice_config import LatticeConfig

LAYERS: dict[type, ModuleType] = {
    pwl.PWLConfig: pwl,
    categorical.CategoricalConfig: categorical,
    linear.LinearConfig: linear,
    LatticeConfig: lattice_layer,
    ensemble.EnsembleConfig: ensemble,
    deep_lattice.DeepLatticeConfig: deep_lattice,
    kronecker.KroneckerConfig: kronecker,
    cdf.CDFConfig: cdf,
    premade.CalibratedConfig: premade,
    aggregation.AggregationConfig: aggregation,
}
"""Configuration -> the module of functions that understands it."""


class Tagged(struct.PyTreeNode, meta.AxisMetadata):
    """Parameters of one layer and what they must satisfy.

    `value`: the parameters; `config`: of the layer; `axes`: positions of axes that flax's lifted
    transformations (`nn.vmap`, `nn.scan`) have added, outermost last.
    """

    value: Any
    config: Any = struct.field(pytree_node=False)
    axes: tuple[int, ...] = struct.field(pytree_node=False, default=())

    def unbox(self) -> Any:
        """The parameters alone, as flax hands them to the module."""
        return self.value

    def replace_boxed(self, val: Any) -> Tagged:
        """The same tag on other parameters."""
        return self.replace(value=val)

    def add_axis(self, index: int, params: dict[Any, Any]) -> Tagged:
        """Remember an axis that a lifted transformation adds."""
        return self.replace(axes=(*self.axes, index))

    def remove_axis(self, index: int, params: dict[Any, Any]) -> Tagged:
        """Forget the axis that was added last."""
        if not self.axes or self.axes[-1] != index:
            raise refusal(
                "index", index, f"the last of the axes {self.axes}", "undo the last first"
            )
        return self.replace(axes=self.axes[:-1])


def layer_of(config: Any) -> ModuleType:
    """The module whose `init`, `apply`, `project` and `check` take this configuration.

    Raises:
        TypeError: not the configuration of a layer.
    """
    for kind, module in LAYERS.items():
        if isinstance(config, kind):
            return module
    known = ", ".join(kind.__name__ for kind in LAYERS)
    raise TypeError(f"config={config!r}: expected one of {known}; make it first")


def tag(config: Any, params: Any) -> Tagged:
    """Parameters of a layer, with their configuration: for trees that flax does not make.

    Args:
        config: of the layer.
        params: of the layer, e.g. from its `init`.

    Returns:
        Tagged; `.value` are the parameters.

    Raises:
        TypeError: `config` is not that of a layer.

    Example:
        >>> config = pwl.PWLConfig(1, 3, monotonicity=1)
        >>> tree = {"curve": tag(config, pwl.PWLParams(jnp.array([[0.0, 2.0, 1.0]])))}
        >>> project_tree(tree)["curve"].value.outputs.tolist()
        [[0.0, 1.5, 1.5]]
    """
    layer_of(config)
    return Tagged(params, config)


def init_tagged(key: Array, config: Any, dtype: Any = jnp.float32) -> Tagged:
    """Tagged parameters of a layer in a given type, feasible in it.

    Args:
        key: typed key, or the legacy key that many flax programs pass.
        config: of the layer.
        dtype: of the parameters.

    Returns:
        Tagged parameters of `layer_of(config).init`.
    """
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.wrap_key_data(key)
    layer = layer_of(config)
    params = layer.init(key, config)
    if jnp.dtype(dtype) != jnp.float32:
        params = layer.project(config, jax.tree.map(lambda a: a.astype(dtype), params))
    return tag(config, params)


def _is_tagged(node: Any) -> bool:
    return isinstance(node, Tagged)


def _over_axes(function: Callable[[Any], Any], axes: tuple[int, ...]) -> Callable[[Any], Any]:
    for axis in axes:
        function = jax.vmap(function, axis, axis)
    return function


def _absent(node: Tagged) -> bool:
    """Whether optax has masked the node out; half a node cannot be projected."""
    leaves = jax.tree.leaves(node.value, is_leaf=lambda x: isinstance(x, optax.MaskedNode))
    masked = [isinstance(leaf, optax.MaskedNode) for leaf in leaves]
    if any(masked) and not all(masked):
        raise refusal(
            "mask", node.config, "all or nothing of the parameters of one layer",
            "give the mask one value for the whole layer",
        )  # fmt: skip
    return all(masked)


def project_tree(params: Any) -> Any:
    """Every tagged layer of a tree projected onto its constraints; all else as it is.

    Args:
        params: any tree: a flax `params` collection, `nnx.state(model)`, a dictionary.

    Returns:
        The same tree with `check_tree(...) == 0`.

    Raises:
        ValueError: the tree holds no tagged layer, or a mask hides half of one.

    Example:
        >>> import jax.numpy as jnp
        >>> from fusion.lattice.linear import LinearConfig, LinearParams
        >>> config = LinearConfig(2, monotonicity=(1, 1))
        >>> layer = tag(config, LinearParams(jnp.array([[-1.0, 2.0]])))
        >>> float(check_tree({"first": layer})), float(check_tree(project_tree({"first": layer})))
        (1.0, 0.0)
    """

    def one(node: Any) -> Any:
        if not _is_tagged(node) or _absent(node):
            return node
        project = layer_of(node.config).project
        return node.replace(
            value=_over_axes(lambda p: project(node.config, p), node.axes)(node.value)
        )

    _require_tags(params)
    return jax.tree.map(one, params, is_leaf=_is_tagged)


def check_tree(params: Any) -> Float[Array, ""]:
    """Largest violation of any constraint in a tree of tagged layers; 0 where all hold.

    Args:
        params: as for `project_tree`.

    Returns:
        The violation `[]`.

    Raises:
        ValueError: as for `project_tree`.

    Example:
        >>> import jax.numpy as jnp
        >>> from fusion.lattice.linear import LinearConfig, LinearParams
        >>> config = LinearConfig(2, monotonicity=(1, 1))
        >>> layer = tag(config, LinearParams(jnp.array([[-1.0, 2.0]])))
        >>> float(check_tree([layer, "anything else"]))
        1.0
    """
    _require_tags(params)
    worst = jnp.zeros(())
    for node in jax.tree.leaves(params, is_leaf=_is_tagged):
        if _is_tagged(node) and not _absent(node):
            check, config = layer_of(node.config).check, node.config
            found = lambda p, check=check, config=config: check(config, p)  # noqa: E731
            for axis in node.axes:
                found = jax.vmap(found, axis)
            worst = jnp.maximum(worst, jnp.max(found(node.value)).astype(worst.dtype))
    return worst


def _require_tags(params: Any) -> None:
    if not any(_is_tagged(n) for n in jax.tree.leaves(params, is_leaf=_is_tagged)):
        raise refusal(
            "params",
            jax.tree.structure(params),
            "a tree with a tagged layer (nn.unbox takes the tags away)",
            "make it with the modules of fusion.lattice.linen or nnx, or with tag(config, params)",
        )
