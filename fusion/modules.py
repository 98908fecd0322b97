"""ARGate and its loss as flax modules around encoders and heads of any kind.

`ARGate` fuses what the given encoders make of each sensor's reading, `ARGateLoss` trains it. Both
compute with the functions that the models of `fusion.models` are built from: the gate, the weighted
fusion, the penalty of Equations 3.1 and 3.2 and the lattice targets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion.gating import Fusion, Gate, Normalizer, Scaling, apply_weights, available_weights
from fusion.lattice import project_tree
from fusion.lattice.deep_lattice import DeepLatticeParams
from fusion.lattice.tagged import Tagged
from fusion.losses import LossConfig, LossParams, LossTerms, cross_entropy, gate_penalty
from fusion.targets import (
    TargetConfig,
    apply_targets,
    init_targets,
    lattice_config,
    project_targets,
)


class ARGateOutput(NamedTuple):
    """What a fusion network gives.

    Attributes:
        output: of the head, such as logits `[batch, class]`.
        weights: fusion weights `[batch, sensor]`; rows sum to one.
        features: of the encoders, `[sensor, batch, feature]`.
        auxiliary: of each auxiliary head, alone on its sensor; empty without heads.
    """

    output: Array
    weights: Float[Array, "b k"]
    features: Float[Array, "k b f"]
    auxiliary: tuple[Array, ...]


class LatticeTargets(nn.Module):
    """The monotone lattice networks of Equation 3.2 as a module: losses in, targets out.

    `[batch, sensor] -> [batch, sensor]`; its parameters must be projected after every step: they
    are tagged, so that `fusion.lattice.with_projection(optimizer)` does it, or `project_argate`.

    Attributes:
        config: sizes of the networks.

    Source: Shim (2020), Eq. 3.2.
    """

    config: TargetConfig = TargetConfig()

    @nn.compact
    def __call__(self, losses: Float[Array, "b k"]) -> Float[Array, "b k"]:
        """Return the fusion-weight targets of every example."""
        n_sensors = losses.shape[-1]
        params: Any = self.param("fusion_targets", self._tagged, n_sensors)
        return apply_targets(self.config, params, losses)

    def _tagged(self, key: Array, n_sensors: int) -> Tagged:
        if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.wrap_key_data(key)  # the legacy key that many flax programs pass
        networks = init_targets(key, self.config, n_sensors)
        return Tagged(networks, lattice_config(self.config, n_sensors), axes=(0,))


class ARGate(nn.Module):
    r"""Gated fusion of any encoders.

    .. math:: z_k = E_k(x_k), \quad w = \mathrm{norm}(G(z_1 .. z_K)), \quad
        y = H\left(\Vert_k\, K w_k z_k\right), \quad y_k = A_k(z_k)

    Attributes:
        encoders: one module for each sensor, `[batch, ...] -> [batch, feature]`, all with the same
            number of features.
        head: reads the fused features `[batch, K * feature]` (`feature` with `fusion="sum"`).
        auxiliary_heads: one module for each sensor on its features `[batch, feature]`, with outputs
            like the head's; none for a gate without auxiliary paths.
        targets: of the fusion weights, a module from losses to targets such as `LatticeTargets`;
            None for the fixed targets of `fusion.losses.loss_targets`.
        gate_width: hidden units of the gate.
        normalizer, fusion, scale: see `fusion.config.ModelConfig`.

    Source: Shim (2020), section 3.2 and Figures 3.1 and 3.3.

    Example:
        >>> net = ARGate((nn.Dense(4), nn.Dense(4)), nn.Dense(3))
        >>> readings = [jnp.ones((5, 7)), jnp.ones((5, 2))]
        >>> params = net.init(jax.random.key(0), readings)
        >>> net.apply(params, readings).output.shape
        (5, 3)
    """

    encoders: Sequence[nn.Module]
    head: nn.Module
    auxiliary_heads: Sequence[nn.Module] = ()
    targets: nn.Module | None = None
    gate_width: int = 32
    normalizer: Normalizer = "softmax"
    fusion: Fusion = "concat"
    scale: Scaling = "mean"

    def setup(self) -> None:
        """Make the gate, and check that heads and encoders belong together."""
        n, heads = len(self.encoders), len(self.auxiliary_heads)
        if n < 1:
            raise ValueError("encoders=(): expected one module for each sensor; give at least one")
        if heads not in (0, n):
            raise ValueError(
                f"auxiliary_heads={heads} modules: expected none or {n}, one for each encoder; "
                "give the missing ones"
            )
        if self.targets is not None and not heads:
            raise ValueError(
                "targets=module: expected auxiliary_heads with it; targets are made of their losses"
            )
        self.gate = Gate(self.gate_width, self.normalizer)

    def __call__(
        self, readings: Sequence[Any], available: Bool[Array, "b k"] | None = None
    ) -> ARGateOutput:
        """Fuse one batch of readings.

        Args:
            readings: what each encoder reads, batch axis first; their shapes may differ.
            available: False for sensors that sent nothing; their features have no influence.
        """
        if len(readings) != len(self.encoders):
            raise ValueError(
                f"readings={len(readings)} sensors: expected {len(self.encoders)}, one for each "
                "encoder; give them in the order of the encoders"
            )
        features = self._features(readings)
        if available is not None:
            features = jnp.where(available.T[:, :, None], features, jnp.zeros_like(features))
        weights = self.gate(features)
        if available is not None:
            weights = available_weights(weights, available)
        fused = apply_weights(features, weights, self.fusion, self.scale)
        auxiliary = tuple(head(features[k]) for k, head in enumerate(self.auxiliary_heads))
        if self.is_initializing() and self.targets is not None:
            self.fusion_targets(jnp.zeros_like(weights))
        return ARGateOutput(self.head(fused), weights, features, auxiliary)

    def _features(self, readings: Sequence[Any]) -> Float[Array, "k b f"]:
        features = [encode(x) for encode, x in zip(self.encoders, readings, strict=True)]
        shapes = {z.shape for z in features}
        if len(shapes) > 1 or features[0].ndim != 2:
            raise ValueError(
                f"encoders=modules with outputs {[z.shape for z in features]}: expected one shape "
                "[batch, feature] for all; end each with a layer of the same width"
            )
        return jnp.stack(features)

    def fusion_targets(self, losses: Float[Array, "b k"]) -> Float[Array, "b k"] | None:
        """Targets of the fusion weights from the losses of the auxiliary heads; None for fixed."""
        return None if self.targets is None else self.targets(losses)


class ARGateLoss(nn.Module):
    r"""The training loss of an `ARGate`, Equations 3.1 and 3.2, for any task.

    .. math:: L = L_{main} + \alpha \sum_k w_k L^{aux}_k + \beta \sum_k (w_k - t_k)^2
        + \lambda \sum_k \left(t_k - \text{softmax}(-L^{aux}/\tau)_k\right)^2

    The parameters of the network are under `model`: `net.apply({"params": params["model"]},
    readings)` predicts without the loss.

    Attributes:
        model: the network.
        config: terms and gradient paths; what it asks for must be in the network.
        task_loss: loss of each example from an output and labels, `[batch]`; cross entropy of
            logits and class numbers by default.

    Source: Shim (2020), Eq. 3.1 and 3.2. Deviation: the anchor term, off by default.
    """

    model: ARGate
    config: LossConfig = LossConfig(learned_targets=False, label_smoothing=0.0)
    task_loss: Callable[[Any, Any], Array] = cross_entropy

    def __call__(
        self,
        params: LossParams,
        readings: Sequence[Any],
        labels: Any,
        available: Bool[Array, "b k"] | None = None,
    ) -> LossTerms:
        """The terms of the loss of one batch, scalars; `total` is to be minimized."""
        config, out = self.config, self.model(readings, available)
        self._check(out)
        main = jnp.mean(self.task_loss(out.output, labels))
        if not config.auxiliary:
            zero = jnp.zeros_like(main)
            return LossTerms(main, main, zero, zero, zero)
        losses = jnp.stack([self.task_loss(y, labels) for y in out.auxiliary], axis=-1)
        targets = None
        if config.learned_targets:
            given = jax.lax.stop_gradient(losses) if config.stop_targets else losses
            targets = self.model.fusion_targets(given)
        gate = gate_penalty(config, params, out.weights, losses, targets)
        return LossTerms(main + gate.total, main, gate.auxiliary, gate.regularization, gate.anchor)

    def _check(self, out: ARGateOutput) -> None:
        config = self.config
        if config.auxiliary and not out.auxiliary:
            raise ValueError(
                "config.auxiliary=True: expected a model with auxiliary_heads; give them, or turn "
                "the terms off"
            )
        for name, wanted in (("mask_supervision", False), ("target_training", "imitation")):
            if (given := getattr(config, name)) != wanted:
                raise ValueError(
                    f"config.{name}={given!r}: expected {wanted!r}, for an ARGateLoss knows no "
                    "masks and takes no steps; add fusion.losses.mask_penalty or "
                    "product_of_experts to its terms"
                )
        if config.learned_targets != (self.model.targets is not None):
            raise ValueError(
                f"config.learned_targets={config.learned_targets}: expected a model "
                f"{'with' if config.learned_targets else 'without'} targets; give both or neither"
            )


def project_argate(config: TargetConfig, params: Any) -> Any:
    """Parameters whose lattice targets, at any depth of any tree, are monotone again.

    Other tagged layers of `fusion.lattice` are projected, too; all else is unchanged.

    To be applied after every step of the optimizer on the parameters of a network with
    `LatticeTargets`, whose `config` is given.

    Example:
        >>> net = LatticeTargets()
        >>> params = net.init(jax.random.key(0), jnp.zeros((1, 2)))
        >>> same = project_argate(net.config, params)
        >>> jax.tree.structure(same) == jax.tree.structure(params)
        True
    """

    def one(path: Any, node: Any) -> Any:
        if isinstance(node, Tagged):
            return project_tree(node)
        # Without their tag, as after `nn.unbox`, they are known by name.
        named = path and getattr(path[-1], "key", None) == "fusion_targets"
        return project_targets(config, node) if named else node

    return jax.tree_util.tree_map_with_path(
        one, params, is_leaf=lambda node: isinstance(node, Tagged | DeepLatticeParams)
    )
