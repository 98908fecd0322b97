"""Calibrated models from a description of their features: linear, lattice, ensemble of lattices.

Every input goes through its own calibrator (piecewise linear, or one output for each category),
the calibrated inputs through one linear layer, lattice or ensemble, and the result through a rising
output calibrator. Directions and orders asked of a feature hold for the whole model. Relations
between features are those of a lattice (`LatticeConfig`) between the calibrated inputs. Most of
them compare outputs or the signs of slopes, which a rising output calibrator keeps; Edgeworth trust
and range dominance compare differences of outputs, which only a straight one keeps.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice import categorical, ensemble, lattice_layer, linear, pwl
from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_range,
    require_static,
    require_width,
)
from fusion.lattice.features import Feature, related_positions
from fusion.lattice.lattice_config import LatticeConfig


@dataclasses.dataclass(frozen=True)
class CalibratedConfig:
    """A calibrated model.

    Attributes:
        features: one for each input; those of numbers all have as many keypoints.
        kind: what combines the calibrated inputs.
        subsets: inputs of each lattice of an ensemble; `random_features` makes them.
        lattice_size: vertices along each axis of a lattice.
        n_output_keypoints: keypoints of the output calibrator.
        output_range: `(low, high)` of the output, either of which may be None.
        missing: numbers that are NaN get a learned output of their own.
        interpolation: of the lattices.
        relations: of features by name, each the name of a constraint of `LatticeConfig` and its
            entry: `("edgeworth_trust", "rating", "reviews", 1)`, `("dominance", "a", "b")`,
            `("joint_unimodality", ("a", "b"), -1)`. The direction of a trust is that of the
            conditional feature, also where the model falls with it. A linear model has dominances
            only; subsets of an ensemble hold related features together, see
            `features.together`.

    Raises:
        ValueError: what contradicts itself, by name and value.
    """

    features: tuple[Feature, ...]
    kind: Literal["linear", "lattice", "ensemble"] = "lattice"
    subsets: tuple[tuple[int, ...], ...] = ()
    lattice_size: int = 2
    n_output_keypoints: int = 10
    output_range: tuple[float | None, float | None] = (None, None)
    missing: bool = False
    interpolation: Literal["hypercube", "simplex"] = "hypercube"
    relations: tuple[tuple[Any, ...], ...] = ()

    def __post_init__(self) -> None:
        """Refuse what contradicts itself; the layers check the rest."""
        require_static(self)
        require_count("len(features)", len(self.features))
        require_count("lattice_size", self.lattice_size, 2)
        require_range("output_range", self.output_range)
        if self.kind not in ("linear", "lattice", "ensemble"):
            raise refusal("kind", self.kind, "'linear', 'lattice' or 'ensemble'", "choose one")
        if (self.kind == "ensemble") != bool(self.subsets):
            raise refusal(
                "subsets", self.subsets, "subsets for an ensemble, () otherwise",
                "make them with random_features",
            )  # fmt: skip
        if self.kind == "lattice" and self.lattice_size ** len(self.features) > 2**20:
            raise refusal(
                "features", len(self.features), "at most 2^20 vertices in one lattice",
                "use kind='ensemble'",
            )  # fmt: skip
        _ = self.numbers, self.categories, self.body, self.output

    @property
    def number_columns(self) -> tuple[int, ...]:
        """Positions of the inputs that are numbers."""
        return tuple(i for i, f in enumerate(self.features) if f.n_categories is None)

    @property
    def _top(self) -> float:
        return 1.0 if self.kind == "linear" else self.lattice_size - 1.0

    @property
    def numbers(self) -> pwl.PWLConfig | None:
        """Calibrators of the numbers, to the range of the next layer."""
        chosen = [self.features[i] for i in self.number_columns]
        if not chosen:
            return None
        return pwl.PWLConfig(
            len(chosen),
            len(chosen[0].keypoints),
            monotonicity=tuple(f.monotonicity for f in chosen),
            output_range=(0.0, self._top),
            keypoints=tuple(f.keypoints for f in chosen),
            missing_value=float("nan") if self.missing else None,
            convexity=tuple(f.convexity for f in chosen),
        )

    @property
    def categories(self) -> tuple[categorical.CategoricalConfig, ...]:
        """Calibrators of the categorical inputs."""
        return tuple(
            categorical.CategoricalConfig(f.n_categories, f.order, (0.0, self._top))
            for f in self.features
            if f.n_categories is not None
        )

    @property
    def body(self) -> Any:
        """Configuration of what combines the calibrated inputs, to [0, 1] or [-1, 1]."""
        signs = tuple(f.sign for f in self.features)
        related: dict[str, Any] = dict(related_positions(self.features, self.relations))
        self._check_relations(related)
        if self.kind == "linear":
            # All inputs have the range [0, 1]: wider over the range is steeper.
            pairs = tuple(pair for entries in related.values() for pair in entries)
            return linear.LinearConfig(
                len(signs), monotonicity=signs, dominance=pairs, normalized=True
            )
        if self.kind == "lattice":
            return LatticeConfig(
                (self.lattice_size,) * len(signs),
                signs,
                output_range=(0.0, 1.0),
                interpolation=self.interpolation,
                **related,
            )
        return ensemble.EnsembleConfig(
            len(signs),
            self.subsets,
            self.lattice_size,
            signs,
            output_range=(0.0, 1.0),
            interpolation=self.interpolation,
            **related,
        )

    def _check_relations(self, related: dict[str, Any]) -> None:
        for name in related:
            if self.kind == "linear" and name not in ("dominance", "range_dominance"):
                raise refusal(
                    "relations", name, "dominance or range_dominance in a linear model",
                    "use kind='lattice' or 'ensemble'",
                )  # fmt: skip
            bent = self.n_output_keypoints > 2
            if bent and name in ("edgeworth_trust", "range_dominance"):
                raise refusal(
                    "relations", name, "a straight output calibrator beside it, since a bent one "
                    "changes differences of outputs", "set n_output_keypoints=2",
                )  # fmt: skip

    @property
    def output(self) -> pwl.PWLConfig:
        """The output calibrator, which never falls."""
        low = -1.0 if self.kind == "linear" else 0.0
        return pwl.PWLConfig(
            1, self.n_output_keypoints, (low, 1.0), 1, output_range=self.output_range
        )


class CalibratedParams(NamedTuple):
    """Parameters of `numbers`, each of `categories`, `body` and `output`."""

    numbers: pwl.PWLParams | None
    categories: tuple[categorical.CategoricalParams, ...]
    body: Any
    output: pwl.PWLParams


_BODIES = {"linear": linear, "lattice": lattice_layer, "ensemble": ensemble}


def init(key: Key[Array, ""], config: CalibratedConfig) -> CalibratedParams:
    """Straight calibrators, the first parameters of the body; feasible.

    Args:
        key: typed key.
        config: of the model.

    Returns:
        CalibratedParams.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    keys = jax.random.split(key, 3 + len(config.categories))
    return CalibratedParams(
        None if config.numbers is None else pwl.init(keys[0], config.numbers),
        tuple(categorical.init(k, c) for k, c in zip(keys[3:], config.categories, strict=True)),
        _BODIES[config.kind].init(keys[1], config.body),
        pwl.init(keys[2], config.output),
    )


def apply(
    config: CalibratedConfig, params: CalibratedParams, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch"]:
    r"""The model's output.

    .. math:: f(x) = c_{out}\big(g(c_1(x_1), \ldots, c_n(x_n))\big)

    Symbols: :math:`c_i` are the calibrators of the inputs; :math:`g` is the linear layer, lattice
    or ensemble; :math:`c_{out}` is the output calibrator.

    Args:
        config: of the model.
        params: of the model.
        x: inputs, categories as whole numbers among them.

    Returns:
        One number for each row.

    Source: Gupta et al. (2016), Monotonic calibrated interpolated look-up tables; for ensembles
    Canini et al. (2016).

    Example:
        >>> config = CalibratedConfig((Feature("age", 1), Feature("kind", n_categories=3)))
        >>> params = init(jax.random.key(0), config)
        >>> y = apply(config, params, jnp.array([[0.2, 1.0], [0.9, 1.0]]))
        >>> bool(y[1] >= y[0])
        True
    """
    require_width(x, len(config.features), "premade.apply")
    columns: list[Any] = [None] * len(config.features)
    if config.numbers is not None and params.numbers is not None:
        chosen = np.asarray(config.number_columns)
        calibrated = pwl.apply(config.numbers, params.numbers, x[..., chosen])
        for place, column in enumerate(config.number_columns):
            columns[column] = calibrated[..., place]
    free = [i for i, column in enumerate(columns) if column is None]
    for i, part, held in zip(free, config.categories, params.categories, strict=True):
        columns[i] = categorical.apply(part, held, x[..., i].astype(jnp.int32))
    h = _BODIES[config.kind].apply(config.body, params.body, jnp.stack(columns, axis=-1))
    h = h if config.kind == "linear" else h[..., None]
    return pwl.apply(config.output, params.output, h)[..., 0]


def project(config: CalibratedConfig, params: CalibratedParams) -> CalibratedParams:
    """Each part projected onto its own constraints, which together hold for the model.

    Args:
        config: of the model.
        params: of the model.

    Returns:
        CalibratedParams with `check(...) == 0`.
    """
    numbers = None
    if config.numbers is not None:
        assert params.numbers is not None
        numbers = pwl.project(config.numbers, params.numbers)
    return CalibratedParams(
        numbers,
        tuple(
            categorical.project(c, p)
            for c, p in zip(config.categories, params.categories, strict=True)
        ),
        _BODIES[config.kind].project(config.body, params.body),
        pwl.project(config.output, params.output),
    )


def check(config: CalibratedConfig, params: CalibratedParams) -> Float[Array, ""]:
    """Largest violation in any part; 0 where all constraints hold."""
    parts = [
        _BODIES[config.kind].check(config.body, params.body),
        pwl.check(config.output, params.output),
    ]
    if config.numbers is not None:
        assert params.numbers is not None
        parts.append(pwl.check(config.numbers, params.numbers))
    pairs = zip(config.categories, params.categories, strict=True)
    parts += [categorical.check(c, p) for c, p in pairs]
    return jnp.max(jnp.stack(parts))
