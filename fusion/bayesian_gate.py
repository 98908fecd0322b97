"""A gate whose weights are distributions: Bayesian fusion weights by mean-field variation.

Every parameter of the variational layers has a Gaussian of its own. The scores of an example are
then Gaussian, too, so that training draws scores instead of parameters (local reparametrization),
and inference may carry means and variances through the gate in one pass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from fusion._checks import check_key
from fusion.gating import Normalizer, normalize

GateKind = Literal["deterministic", "variational", "variational_whole"]
INITIAL_SPREAD = -3.0
"""Log of the first standard deviation over the prior's: small, so that training starts as ever."""


def gaussian_divergence(
    mean: Float[Array, "*s"], spread: Float[Array, "*s"], prior: float = 1.0
) -> Float[Array, ""]:
    r"""Divergence of independent Gaussians from their common prior, summed.

    .. math::
        \text{KL}\left(N(\mu, \sigma^2) \,\Vert\, N(0, \sigma_0^2)\right)
            = \textstyle\sum_i \left[-\rho_i
            + \tfrac12 \left(e^{2 \rho_i} + \mu_i^2 / \sigma_0^2 - 1\right)\right],
        \qquad \sigma_i = \sigma_0 e^{\rho_i}

    Args:
        mean: :math:`\mu`.
        spread: :math:`\rho`, log standard deviation over that of the prior; 0 is the prior's.
        prior: :math:`\sigma_0`, > 0.

    Returns:
        A scalar in nats; 0 for the prior itself, else positive.

    Source: Blundell et al. (2015), with a Gaussian prior in closed form.
    """
    return jnp.sum(-spread + 0.5 * (jnp.exp(2.0 * spread) + (mean / prior) ** 2 - 1.0))


def gate_divergence(gate: Mapping[str, Any], prior: float = 1.0) -> Float[Array, ""]:
    """Sum of `gaussian_divergence` over all pairs `name`, `name_spread` of a gate's parameters."""
    total = jnp.zeros(())
    for name, value in gate.items():
        if isinstance(value, Mapping):
            total = total + gate_divergence(value, prior)
        elif f"{name}_spread" in gate:
            total = total + gaussian_divergence(value, gate[f"{name}_spread"], prior)
    return total


def relu_moments(
    mean: Float[Array, "*s"], variance: Float[Array, "*s"]
) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    r"""Mean and variance of a rectified Gaussian.

    .. math::
        E[r] = m \Phi(m/s) + s \varphi(m/s), \qquad
        E[r^2] = (m^2 + s^2) \Phi(m/s) + m s \varphi(m/s)

    Args:
        mean: m; variance: :math:`s^2`, >= 0; where it is 0 the result is the rectified mean.

    Returns:
        Mean and variance of :math:`r = \max(0, a)`, :math:`a \sim N(m, s^2)`.

    Source: Frey and Hinton (1999).
    """
    s = jnp.sqrt(jnp.maximum(variance, 1e-12))
    z = mean / s
    inside = 0.5 * (1.0 + jax.lax.erf(z / math.sqrt(2.0)))
    density = jnp.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    first = mean * inside + s * density
    second = (mean**2 + s**2) * inside + mean * s * density
    return first, jnp.maximum(second - first**2, 0.0)


class VariationalDense(nn.Module):
    r"""A dense layer with independent Gaussian parameters: moments in, moments out.

    .. math::
        m' = m W + c, \qquad
        v' = (m^2 + v)\, \sigma_W^2 + v\, W^2 + \sigma_c^2

    with W, c the means and :math:`\sigma` the standard deviations of the parameters; inputs are
    taken to be independent of each other.

    Attributes:
        features: width of the result.
        prior: standard deviation of the prior of every parameter.
        start: first spread, see `gaussian_divergence`.
        zeros: means of the weights start at zero, else at LeCun's draw.

    Source: Kingma et al. (2015), local reparametrization.
    """

    features: int
    prior: float
    start: float = INITIAL_SPREAD
    zeros: bool = False

    @nn.compact
    def __call__(
        self, mean: Float[Array, "b i"], variance: Float[Array, "b i"] | None = None
    ) -> tuple[Float[Array, "b o"], Float[Array, "b o"]]:
        """Return mean and variance of the result, for given or uncertain inputs."""
        first = nn.initializers.zeros if self.zeros else nn.initializers.lecun_normal()
        spread = nn.initializers.constant(self.start)
        shape = mean.shape[-1], self.features
        kernel = self.param("kernel", first, shape)
        bias = self.param("bias", nn.initializers.zeros, shape[1:])
        sd = self.prior * jnp.exp(self.param("kernel_spread", spread, shape))
        bias_sd = self.prior * jnp.exp(self.param("bias_spread", spread, shape[1:]))
        square = mean**2 if variance is None else mean**2 + variance
        spread_out = square @ sd**2 + (bias_sd**2)[None, :]
        if variance is not None:
            spread_out = spread_out + variance @ kernel**2
        return mean @ kernel + bias[None, :], spread_out


class VariationalGate(nn.Module):
    r"""The gate of `fusion.gating.Gate` with distributions over its last layer, or over all of it.

    .. math::
        s_k \sim N(m_k, v_k), \qquad w = \text{softmax}(s), \qquad
        m = h W + c, \quad v = h^2 \sigma_W^2 + \sigma_c^2

    Called without a key it gives the weights of the mean parameters, with a key those of one draw
    for each example. `moments` gives m and v.

    Attributes:
        width: of the hidden layer.
        normalizer: of the scores.
        own_scores: as in `fusion.gating.Gate`; part of the last layer.
        prior: standard deviation of the prior of every parameter.
        whole: the hidden layer is variational, too.

    Source: Shim (2020), chapter 5 (Bayesian fusion weights, proposed there).
    """

    width: int
    normalizer: Normalizer
    own_scores: bool = False
    prior: float = 1.0
    whole: bool = False

    @nn.compact
    def _scores(
        self, features: Float[Array, "k b f"], key: Array | None, propagate: bool
    ) -> tuple[Array, Array]:
        k, b, _ = features.shape
        joined = jnp.transpose(features, (1, 0, 2)).reshape(b, -1)
        variance = None
        if self.whole:
            # Its inputs are many: a smaller start keeps the first draws near the means.
            layer = VariationalDense(self.width, self.prior, INITIAL_SPREAD - 2.0, name="fc_con")
            mean, spread = layer(joined)
            if propagate:
                hidden, variance = relu_moments(mean, spread)
            elif key is None:
                hidden = nn.relu(mean)
            else:
                noise = jax.random.normal(jax.random.fold_in(key, 1), mean.shape, mean.dtype)
                hidden = nn.relu(mean + jnp.sqrt(spread) * noise)
        else:
            hidden = nn.relu(nn.Dense(self.width, name="fc_con")(joined))
        mean, spread = VariationalDense(k, self.prior, zeros=True, name="split")(hidden, variance)
        if self.own_scores:
            shape = features.shape[::2]
            own = self.param("own", nn.initializers.zeros, shape)
            start = nn.initializers.constant(INITIAL_SPREAD)
            sd = self.prior * jnp.exp(self.param("own_spread", start, shape))
            mean = mean + jnp.einsum("kbf,kf->bk", features, own)
            spread = spread + jnp.einsum("kbf,kf->bk", features**2, sd**2)
        return mean, spread

    def __call__(
        self, features: Float[Array, "k b f"], key: Key[Array, ""] | None = None
    ) -> Float[Array, "b k"]:
        """Return the fusion weights of every example: of the mean gate, or of one draw."""
        mean, variance = self._scores(features, key, False)
        if key is not None:
            check_key(key)
            noise = jax.random.normal(jax.random.fold_in(key, 0), mean.shape, mean.dtype)
            mean = mean + jnp.sqrt(variance) * noise
        return normalize(mean, self.normalizer)

    def moments(
        self, features: Float[Array, "k b f"]
    ) -> tuple[Float[Array, "b k"], Float[Array, "b k"]]:
        """Return mean and variance of every score; exact where the last layer alone varies."""
        return self._scores(features, None, True)
