"""Fusion weights: how they are computed from the features, normalized, and applied.

Arrays with a sensor axis have it first for features (`[branch, batch, feature]`) and last for
weights (`[batch, branch]`), as a user reads them: one row of weights per example.
"""

from __future__ import annotations

from typing import Literal, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_choice, check_key, check_number

Normalizer = Literal["softmax", "softmax_sigmoid"]
Fusion = Literal["concat", "sum"]
Scaling = Literal["mean", "max"]


def normalize(scores: Float[Array, "*b k"], normalizer: Normalizer | str) -> Float[Array, "*b k"]:
    r"""Turn K scores into weights that are positive and sum to one.

    .. math::
        \text{softmax:} \quad w_k = e^{s_k} / \textstyle\sum_j e^{s_j}
        \qquad
        \text{softmax\_sigmoid:} \quad w_k = e^{\sigma(s_k)} / \textstyle\sum_j e^{\sigma(s_j)}

    Args:
        scores: one score per sensor, any leading axes.
        normalizer: `"softmax_sigmoid"` is the source as printed (section 3.2.1). Its weights are
            confined: for K = 9 to [0.044, 0.254], so it cannot express the weights of 0.33 to 0.45
            that the source's Figure 3.7 shows. `"softmax"` can.

    Returns:
        Weights with the shape of `scores`.

    Source: Shim (2020), section 3.2.1 and Eq. 3.1.
    """
    check_choice("normalizer", normalizer, get_args(Normalizer))
    if normalizer == "softmax_sigmoid":
        scores = jax.nn.sigmoid(scores)
    return jax.nn.softmax(scores, axis=-1)


class Gate(nn.Module):
    """The "FC-con" block: concatenated features, one hidden layer, one score per sensor.

    `[branch, batch, feature] -> [batch, branch]`; the last layer starts at zero, so that training
    starts from equal weights.

    Attributes:
        width: of the hidden layer.
        normalizer: of the scores.
        own_scores: each sensor's features also add to its own score directly, without the hidden
            layer; then one flag of a sensor is enough to silence it.

    Source: Patel et al. (IROS 2017), NetGated; Shim (2020), Figures 3.1 and 3.3. Deviation: own
    scores, off by default.
    """

    width: int
    normalizer: Normalizer
    own_scores: bool = False

    def __call__(self, features: Float[Array, "k b f"]) -> Float[Array, "b k"]:
        """Return the fusion weights of every example."""
        return normalize(self.scores(features)[0], self.normalizer)

    @nn.compact
    def scores(
        self, features: Float[Array, "k b f"]
    ) -> tuple[Float[Array, "b k"], Float[Array, "b h"]]:
        """Scores before they are normalized, and the hidden layer that they are linear in."""
        k, b, _ = features.shape
        joined = jnp.transpose(features, (1, 0, 2)).reshape(b, -1)
        hidden = nn.relu(nn.Dense(self.width, name="fc_con")(joined))
        scores = nn.Dense(k, kernel_init=nn.initializers.zeros, name="split")(hidden)
        if self.own_scores:
            own = self.param("own", nn.initializers.zeros, features.shape[::2])
            scores = scores + jnp.einsum("kbf,kf->bk", features, own)
        return scores, hidden


def oracle_weights(failed: Bool[Array, "b k"]) -> Float[Array, "b k"]:
    r"""The gate that is told which sensors failed: equal weights over the healthy ones.

    .. math:: w_k = (1 - m_k) / \max\left(1, \textstyle\sum_j (1 - m_j)\right)

    The upper bound that learned gates are measured against; it needs what no user has.
    """
    healthy = 1.0 - failed.astype(jnp.float32)
    return healthy / jnp.maximum(1.0, jnp.sum(healthy, axis=-1, keepdims=True))


def available_weights(
    weights: Float[Array, "b k"], available: Bool[Array, "b k"]
) -> Float[Array, "b k"]:
    r"""Fusion weights of the sensors that are there, with the sum that all had.

    .. math:: w'_k = a_k w_k / \textstyle\sum_j a_j w_j

    Args:
        weights: of all sensors; rows sum to one.
        available: False where a sensor sent nothing.

    Returns:
        Weights with the shape of `weights`: to the bit the same where all sensors are there, zero
        for absent ones, and zero for all where none is there.

    Example:
        >>> weights, there = jnp.array([[0.5, 0.25, 0.25]]), jnp.array([[False, True, True]])
        >>> available_weights(weights, there).tolist()
        [[0.0, 0.5, 0.5]]
    """
    kept = jnp.where(available, weights, jnp.zeros_like(weights))
    total = jnp.sum(kept, axis=-1, keepdims=True)
    # Where a gate gives all weight to what is absent, the sensors that are there share it.
    count = jnp.sum(available, axis=-1, keepdims=True).astype(weights.dtype)
    even = available.astype(weights.dtype) / jnp.maximum(count, jnp.ones_like(count))
    tiny = jnp.finfo(weights.dtype).tiny
    shared = jnp.where(total > tiny, kept / jnp.maximum(total, tiny), even)
    return jnp.where(jnp.all(available, axis=-1, keepdims=True), weights, shared)


def apply_weights(
    features: Float[Array, "k b f"],
    weights: Float[Array, "b k"],
    fusion: Fusion | str = "concat",
    scale: Scaling | str = "mean",
) -> Float[Array, "b g"]:
    r"""Weight the features and join them.

    .. math::
        h = \big\Vert_k K w_k z_k \quad (\text{concat}) \qquad
        h = \textstyle\sum_k w_k z_k \quad (\text{sum})

    The factor K (`scale="mean"`) makes equal weights the identity, so that a gated network and
    the baseline start from the same function. `scale="max"` divides by the largest weight
    instead: healthy sensors then pass unchanged however many have failed, but a gate without
    auxiliary paths trains badly (it can shut informative sensors off early).
    """
    check_choice("fusion", fusion, get_args(Fusion))
    check_choice("scale", scale, get_args(Scaling))
    k, b, _ = features.shape
    gain = weights / jnp.max(weights, axis=-1, keepdims=True) if scale == "max" else k * weights
    gated = features * gain.T[:, :, None]
    if fusion == "concat":
        return jnp.transpose(gated, (1, 0, 2)).reshape(b, -1)
    return jnp.mean(gated, axis=0)


def drop_modalities(
    features: Float[Array, "k b f"], rate: float, *, key: Key[Array, ""]
) -> Float[Array, "k b f"]:
    """Modality dropout: each sensor's features are zeroed with probability `rate`, never all.

    The kept ones are scaled by K over their number, as path drop in AVOD divides by the kept count.

    Source: Neverova et al. (2016), ModDrop; Ku et al. (2018), path drop.
    """
    check_number("rate", rate, 0.0, 1.0, fix="it is the probability to drop a sensor")
    check_key(key)
    k, b, _ = features.shape
    draw_key, spare_key = jax.random.split(key)
    keep = jax.random.uniform(draw_key, (k, b)) >= rate
    spare = jax.nn.one_hot(jax.random.randint(spare_key, (b,), 0, k), k, axis=0, dtype=bool)
    keep = jnp.where(jnp.any(keep, axis=0, keepdims=True), keep, spare)
    kept = keep.astype(features.dtype)
    scale = k / jnp.sum(kept, axis=0, keepdims=True)
    return features * (kept * scale)[:, :, None]


def embrace(
    features: Float[Array, "k b f"],
    keep: Float[Array, "b k"] | None = None,
    *,
    key: Key[Array, ""] | None = None,
    shared: bool = False,
) -> Float[Array, "b f"]:
    r"""EmbraceNet fusion: each feature is taken from one sensor, drawn at random.

    .. math:: h_i = z_{r_i, i}, \quad r_i \sim \text{Categorical}(p)

    Without a key the expectation :math:`\sum_k p_k z_{k,i}` is taken, on which the layers behind
    it were not trained.

    Args:
        features: docked features of the K sensors.
        keep: availability of each sensor, `[batch, branch]`; all available when None.
        key: PRNG key of the draws, or None for the expectation.
        shared: one draw for all examples, so that what becomes of one does not depend on the batch
            that it is in.

    Source: Choi and Lee (2019), EmbraceNet.
    """
    k, b, f = features.shape
    weights = jnp.ones((b, k)) if keep is None else keep
    p = weights / jnp.maximum(1e-9, jnp.sum(weights, axis=-1, keepdims=True))
    if key is None:
        return jnp.einsum("bk,kbf->bf", p, features)
    logits = jnp.log(p + 1e-9)[:, None, :]
    if shared:
        choice = jnp.argmax(logits + jax.random.gumbel(key, (1, f, k), p.dtype), axis=-1)
    else:
        choice = jax.random.categorical(key, logits, axis=-1, shape=(b, f))
    selected = jax.nn.one_hot(choice, k, axis=0, dtype=features.dtype)
    return jnp.sum(selected * features, axis=0)
