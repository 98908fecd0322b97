"""Functions of sets: an unknown number of items for each example, none before another.

Every item goes through the same calibrated models, their outputs are averaged over the items of
an example, and one lattice makes the result of the averages. Examples of unequal length come as a
padded array with a mask, or as rows with the number of the example of each.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from fusion.lattice import lattice_layer, premade, pwl
from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_static,
    require_width,
)
from fusion.lattice.lattice_config import LatticeConfig, LatticeParams
from fusion.lattice.ragged import inside, masked_mean, segment_mean
from fusion.lattice.rounding import frame, onto, working


@dataclasses.dataclass(frozen=True)
class AggregationConfig:
    """A function of a set of items.

    Attributes:
        item: the calibrated model that reads one item; its `output_range` is set from here.
        n_functions: such models with parameters of their own, whose averages describe a set.
        lattice_size: vertices along each of these averages in the lattice over them.
        n_output_keypoints: keypoints of the output calibrator.
        output_range: `(low, high)` of the output, either of which may be None.
        interpolation: of the lattice over the averages.

    The output rises or falls with a feature of any item as that feature says.

    Raises:
        ValueError, TypeError: sizes or ranges that mean nothing, by name and value.

    Example:
        >>> from fusion.lattice import Feature
        >>> item = premade.CalibratedConfig((Feature("stars", 1), Feature("words")))
        >>> AggregationConfig(item, n_functions=2).lattice.monotonicity
        (1, 1)
    """

    item: premade.CalibratedConfig
    n_functions: int = 1
    lattice_size: int = 2
    n_output_keypoints: int = 10
    output_range: tuple[float | None, float | None] = (None, None)
    interpolation: Literal["hypercube", "simplex"] = "hypercube"

    def __post_init__(self) -> None:
        """Refuse what means nothing; the layers check the rest."""
        require_static(self)
        require_count("n_functions", self.n_functions)
        require_count("lattice_size", self.lattice_size, 2)
        if self.item.output_range != (None, None):
            raise refusal(
                "item.output_range", self.item.output_range,
                f"(None, None), since the lattice reads [0, {self.lattice_size - 1}]",
                "give output_range of the whole",
            )  # fmt: skip
        if self.lattice_size**self.n_functions > 2**20:
            raise refusal(
                "n_functions", self.n_functions, "at most 2^20 vertices over the averages",
                "lower it, or lattice_size",
            )  # fmt: skip
        _ = self.reader, self.lattice, self.output

    @property
    def top(self) -> float:
        """Largest coordinate of the lattice over the averages."""
        return self.lattice_size - 1.0

    @property
    def reader(self) -> premade.CalibratedConfig:
        """What reads one item, to an axis of the lattice."""
        return dataclasses.replace(self.item, output_range=(0.0, self.top))

    @property
    def lattice(self) -> LatticeConfig:
        """The lattice over the averages, rising wherever a feature has a direction."""
        directed = any(feature.sign for feature in self.item.features)
        return LatticeConfig(
            (self.lattice_size,) * self.n_functions,
            (int(directed),) * self.n_functions,
            output_range=(0.0, 1.0),
            interpolation=self.interpolation,
        )

    @property
    def output(self) -> pwl.PWLConfig:
        """The output calibrator, which never falls."""
        return pwl.PWLConfig(
            1, self.n_output_keypoints, (0.0, 1.0), 1, output_range=self.output_range
        )


class AggregationParams(NamedTuple):
    """`items`: parameters of the readers, with a leading axis `[n_functions]`; `empty`
    `[n_functions]`: what stands for the averages of a set without items; `lattice`, `output`."""

    items: Any
    empty: Array
    lattice: LatticeParams
    output: pwl.PWLParams


def init(key: Key[Array, ""], config: AggregationConfig) -> AggregationParams:
    """The first parameters of each part; an empty set starts in the middle.

    Args:
        key: typed key.
        config: of the function.

    Returns:
        AggregationParams; feasible.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    keys = jax.random.split(key, config.n_functions + 2)
    readers = [premade.init(k, config.reader) for k in keys[2:]]
    return AggregationParams(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *readers),
        jnp.full((config.n_functions,), 0.5 * config.top, jnp.float32),
        lattice_layer.init(keys[0], config.lattice),
        pwl.init(keys[1], config.output),
    )


def apply(
    config: AggregationConfig,
    params: AggregationParams,
    x: Float[Array, "*batch n_items n_features"],
    mask: Bool[Array, "..."],
) -> Float[Array, "*batch"]:
    r"""The output for each set of items.

    .. math:: f(X) = c_{out}\Big(\rho\Big(\frac{1}{|X|} \sum_{x \in X} \phi(x)\Big)\Big)

    Symbols: :math:`\phi` are the `n_functions` calibrated models; :math:`\rho` is the lattice over
    their averages; :math:`c_{out}` is the output calibrator. An empty set has learned averages of
    its own. What padding holds, NaN for one, is not read.

    Args:
        config: of the function.
        params: of the function.
        x: items, padded to the same number; categories as whole numbers among the features.
        mask: `[*batch, n_items]`, True where there is an item.

    Returns:
        One number for each set; the same whatever the order of its items.

    Raises:
        ValueError: `x` has another number of features, or `mask` is not of the shape of the items.

    Source: Cotter et al. (2019), Shape constraints for set functions; the layer `Aggregation` and
    the model `AggregateFunction` of TensorFlow Lattice.

    Example:
        >>> from fusion.lattice import Feature
        >>> config = AggregationConfig(premade.CalibratedConfig((Feature("stars", 1),)))
        >>> params = init(jax.random.key(0), config)
        >>> x = jnp.array([[[0.2], [0.4]], [[0.4], [jnp.nan]]])
        >>> y = apply(config, params, x, jnp.array([[True, True], [True, False]]))
        >>> bool(y[1] > y[0])
        True
    """
    if mask.shape != x.shape[:-1]:
        raise refusal(
            "mask.shape", tuple(mask.shape), f"{tuple(x.shape[:-1])}, one entry for each item",
            "leave out the axis of the features",
        )  # fmt: skip
    values = _read(config, params, x, mask)
    return _conclude(config, params, masked_mean(values, mask, params.empty))


def apply_segments(
    config: AggregationConfig,
    params: AggregationParams,
    x: Float[Array, "n_rows n_features"],
    segment_ids: Int[Array, "..."],
    n_examples: int,
) -> Float[Array, " n_examples"]:
    """As `apply`, for items as rows, each with the number of its example.

    Args:
        config: of the function.
        params: of the function.
        x: the items of all examples.
        segment_ids: `[n_rows]`, the example of each row, in any order; other numbers are padding.
        n_examples: examples, a static number.

    Returns:
        One number for each example.

    Raises:
        ValueError: `x` has another number of features, or `segment_ids` another number of rows.
    """
    require_count("n_examples", n_examples)
    if segment_ids.shape != x.shape[:-1] or x.ndim != 2:
        raise refusal(
            "segment_ids.shape", tuple(segment_ids.shape), f"[n_rows] for x of {tuple(x.shape)}, "
            "[n_rows, n_features]", "give one number for each row",
        )  # fmt: skip
    values = _read(config, params, x, inside(segment_ids, n_examples))
    means = segment_mean(values, segment_ids, n_examples, params.empty)
    return _conclude(config, params, means)


def apply_either(
    config: AggregationConfig,
    params: AggregationParams,
    x: Float[Array, "*items n_features"],
    mask: Bool[Array, "..."] | None,
    segment_ids: Int[Array, "..."] | None,
    n_examples: int | None,
) -> Float[Array, "..."]:
    """`apply` with a mask, `apply_segments` with the other two: what the flax modules call.

    Raises:
        ValueError: neither or both ways are given.
    """
    if mask is not None and segment_ids is None and n_examples is None:
        return apply(config, params, x, mask)
    if mask is None and segment_ids is not None and n_examples is not None:
        return apply_segments(config, params, x, segment_ids, n_examples)
    given = {"mask": mask, "segment_ids": segment_ids, "n_examples": n_examples}
    names = tuple(name for name, value in given.items() if value is not None)
    raise refusal(
        "arguments", names, "mask, or segment_ids and n_examples",
        "write mask=jnp.ones(x.shape[:-1], bool) where all items are there",
    )  # fmt: skip


def _read(config: AggregationConfig, params: AggregationParams, x: Array, mask: Array) -> Array:
    """What each model makes of each item, `[*batch, n_items, n_functions]`."""
    require_width(x, len(config.item.features), "aggregation.apply")
    # Padding may hold anything: neither its outputs nor their slopes may be NaN.
    safe = jnp.where(mask[..., None], x, jnp.zeros_like(x))
    each = jax.vmap(lambda p: premade.apply(config.reader, p, safe), out_axes=-1)
    return each(params.items)


def _conclude(config: AggregationConfig, params: AggregationParams, means: Array) -> Array:
    h = lattice_layer.apply(config.lattice, params.lattice, means)
    return pwl.apply(config.output, params.output, h[..., None])[..., 0]


def project(config: AggregationConfig, params: AggregationParams) -> AggregationParams:
    """Each part projected onto its own constraints, which together hold for the function.

    Args:
        config: of the function.
        params: of the function.

    Returns:
        AggregationParams with `check(...) == 0`.
    """
    empty = onto(frame(params.empty, (0.0, config.top)), params.empty)
    return AggregationParams(
        jax.vmap(lambda p: premade.project(config.reader, p))(params.items),
        empty.astype(params.empty.dtype),
        lattice_layer.project(config.lattice, params.lattice),
        pwl.project(config.output, params.output),
    )


def check(config: AggregationConfig, params: AggregationParams) -> Float[Array, ""]:
    """Largest violation in any part; 0 where all constraints hold."""
    empty = working(params.empty)
    parts = [
        jnp.max(jax.vmap(lambda p: premade.check(config.reader, p))(params.items)),
        jnp.max(jnp.maximum(-empty, empty - config.top)),
        lattice_layer.check(config.lattice, params.lattice),
        pwl.check(config.output, params.output),
    ]
    return jnp.maximum(jnp.max(jnp.stack(parts)), 0.0)
