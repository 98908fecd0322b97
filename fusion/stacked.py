"""Layers of K sensors at once: dense layers and convolutions as one batched matrix product.

Every array has the sensor (branch) axis first, `[branch, batch, ...]`: the K layers are then a
single batched matrix product, which on a CPU is several times faster than K convolutions, and many
times faster inside `jax.lax.scan`, where XLA's CPU convolution is slow.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion._checks import check_choice, check_count

Backend = Literal["matmul", "conv"]


def conv1d(
    x: Float[Array, "k b t c"],
    kernel: Float[Array, "k w c f"],
    bias: Float[Array, "k f"],
    *,
    stride: int = 1,
    backend: Backend | str = "matmul",
) -> Float[Array, "k b t2 f"]:
    r"""K independent one-dimensional convolutions, without padding.

    .. math:: y_{k,b,i,f} = b_{k,f} + \sum_{j,c} x_{k,b,is+j,c}\, W_{k,j,c,f}

    Args:
        x: K batches of series, `[branch, batch, time, channel]`.
        kernel: `[branch, width, channel, feature]`.
        bias: `[branch, feature]`.
        stride: step s between outputs, in samples.
        backend: `"matmul"` gathers the windows and multiplies (fast inside `scan` on a CPU);
            `"conv"` calls XLA's grouped convolution. Both give the same numbers to rounding.

    Returns:
        `[branch, batch, (time - width) // stride + 1, feature]`.
    """
    check_choice("backend", backend, get_args(Backend))
    check_count("stride", stride)
    k, b, t, c = x.shape
    _, w, _, f = kernel.shape
    if t < w:
        raise ValueError(
            f"x.shape={tuple(x.shape)}: expected at least {w} samples, the width of the kernel; "
            "use longer windows or a smaller kernel"
        )
    n = (t - w) // stride + 1
    if backend == "matmul":
        windows = [
            jax.lax.slice_in_dim(x, j, j + (n - 1) * stride + 1, stride, 2) for j in range(w)
        ]
        columns = jnp.concatenate(windows, axis=-1).reshape(k, b * n, w * c)
        y = columns @ kernel.reshape(k, w * c, f)
        return y.reshape(k, b, n, f) + bias[:, None, None, :]
    grouped = jnp.transpose(x, (1, 2, 0, 3)).reshape(b, t, k * c)
    kernels = jnp.transpose(kernel, (1, 2, 0, 3)).reshape(w, c, k * f)
    y = jax.lax.conv_general_dilated(
        grouped,
        kernels,
        (stride,),
        "VALID",
        dimension_numbers=("NWC", "WIO", "NWC"),
        feature_group_count=k,
    )
    return jnp.transpose(y.reshape(b, n, k, f), (2, 0, 1, 3)) + bias[:, None, None, :]


def he_init(key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> Array:
    """He-normal weights for stacked layers: the fan-in leaves out branch and output axes."""
    fan_in = math.prod(shape[1:-1])
    return jax.random.normal(key, shape, dtype) * jnp.asarray(math.sqrt(2.0 / fan_in), dtype)


def stacked_dense(
    module: nn.Module, name: str, x: Float[Array, "k b i"], features: int, scale: float = 1.0
) -> Float[Array, "k b f"]:
    """A dense layer per branch with parameters `name_kernel` and `name_bias` of `module`."""
    k, _, i = x.shape
    kernel = module.param(f"{name}_kernel", lambda key: scale * he_init(key, (k, i, features)))
    bias = module.param(f"{name}_bias", nn.initializers.zeros, (k, features))
    return x @ kernel + bias[:, None, :]
