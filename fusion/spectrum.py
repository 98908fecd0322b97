"""Log power spectrum and moments of windows: features that nothing has to learn."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def _fourier_basis(n: int) -> tuple[np.ndarray, int]:
    """Hann-windowed cosine and sine columns for a real series of n samples, without the mean."""
    bins = n // 2
    angle = 2.0 * np.pi * np.outer(np.arange(n), np.arange(1, bins + 1)) / n
    window = np.hanning(n)[:, None] * 2.0 / n
    basis = np.concatenate([np.cos(angle), np.sin(angle)], axis=1) * window
    return basis.astype(np.float32), bins


def spectral_features(x: Float[Array, "k b t"]) -> Float[Array, "k b f"]:
    r"""Log power spectrum and moments of each window: fixed, cheap and without parameters.

    .. math:: \log\left(10^{-6} + |\hat x_m|^2\right), \; m = 1 \ldots T/2

    and mean, its square, log standard deviation, maximum, minimum, root mean squared step and mean
    absolute deviation. The constants bring every feature to the order of one for inputs in [-1, 1].
    """
    basis, bins = _fourier_basis(x.shape[-1])
    mean = jnp.mean(x, axis=-1, keepdims=True)
    centred = x - mean
    z = centred @ jnp.asarray(basis)
    power = z[..., :bins] ** 2 + z[..., bins:] ** 2
    sd = jnp.sqrt(jnp.mean(centred**2, axis=-1, keepdims=True) + 1e-8)
    step = jnp.sqrt(jnp.mean(jnp.diff(x, axis=-1) ** 2, axis=-1, keepdims=True) + 1e-8)
    return jnp.concatenate(
        [
            0.25 * jnp.log(power + 1e-6) + 1.5,
            3.0 * mean,
            3.0 * mean**2,
            jnp.log(sd) + 2.0,
            jnp.max(x, axis=-1, keepdims=True),
            jnp.min(x, axis=-1, keepdims=True),
            5.0 * step,
            5.0 * jnp.mean(jnp.abs(centred), axis=-1, keepdims=True),
        ],
        axis=-1,
    )
