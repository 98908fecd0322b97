"""A Gaussian process in standard normal parameters: fitted to what has been simulated, by value."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from failure.models import gp, gp_fit
from failure.models.kernels import GPConfig, noise_variance

UNIT = math.sqrt(12.0)
"""Sigmas per unit coordinate, in which the lengthscale prior is meant: variance 1/12."""


@lru_cache(maxsize=8)
def _programs(config: GPConfig) -> dict[str, Any]:
    """The compiled programs of a configuration; padded data keep their number small."""

    def fit(x: Any, y: Any, n: Any) -> Any:
        found = gp_fit.fit(config, gp_fit.initial_params(config, x.shape[1]), x, y, n, ftol=1e-6)
        return gp.condition(config, found.params, x, y, n)

    def slope(posterior: Any, x: Any) -> Any:
        return jax.vmap(jax.grad(lambda p: gp.predict(config, posterior, p[None])[0][0]))(x)

    return {
        "fit": jax.jit(fit),
        "predict": jax.jit(partial(gp.predict, config)),
        "slope": jax.jit(slope),
        "append": jax.jit(partial(gp.append, config)),
    }


class Emulator:
    """What a Gaussian process knows of a performance function.

    Rows whose output is not finite are left out.

    Args:
        x: `[n, d]` in sigma.
        y: `[n]`.
        config: kernel and priors.

    Example:
        >>> x = np.random.default_rng(0).normal(size=(30, 2))
        >>> mean, sd = Emulator(x, 1e-9 * x[:, 0]).predict(np.array([[1.0, 5.0]]))
        >>> round(1e9 * float(mean[0]), 2)
        1.0
    """

    def __init__(
        self,
        x: Float[np.ndarray, "n d"],
        y: Float[np.ndarray, " n"],
        config: GPConfig | None = None,
    ) -> None:
        good = np.isfinite(y)
        values = np.asarray(y, np.float64)[good]
        if len(values) < 2:
            raise ValueError(f"y with {len(values)} finite values: expected at least 2")
        self._config = config or GPConfig()
        self._programs = _programs(self._config)
        self._mean = float(values.mean())
        spread = float(values.std(ddof=1))
        self._scale = spread if spread > 1e-12 * abs(self._mean) else 1.0
        size, count = gp.padded_size(len(values) + 1), len(values)
        px, py = np.zeros((size, x.shape[1])), np.zeros(size)
        px[:count], py[:count] = x[good] / UNIT, (values - self._mean) / self._scale
        with jax.enable_x64(True):
            self._posterior = self._programs["fit"](
                jnp.asarray(px), jnp.asarray(py), jnp.asarray(count, jnp.int32)
            )

    @property
    def noise(self) -> float:
        """Standard deviation of what the inputs do not explain."""
        with jax.enable_x64(True):
            variance = float(noise_variance(self._config, self._posterior.params))
        return self._scale * math.sqrt(variance)

    def predict(
        self, x: Float[np.ndarray, "m d"]
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Mean and standard deviation of the function, without noise."""
        with jax.enable_x64(True):
            mean, variance = self._programs["predict"](self._posterior, jnp.asarray(x / UNIT))
        return self._mean + self._scale * np.asarray(mean), self._scale * np.sqrt(variance)

    def slope(self, x: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
        """Gradient of the mean."""
        with jax.enable_x64(True):
            return (self._scale / UNIT) * np.asarray(
                self._programs["slope"](self._posterior, jnp.asarray(x / UNIT))
            )
