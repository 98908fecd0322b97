"""The feature extractor of one view: an encoder, and a decoder back to full resolution.

Source: Ku et al. (2018), AVOD, section III-B; the encoder is VGG16 (Simonyan, Zisserman, 2015) at
half width, the decoder follows feature pyramids (Lin et al., 2017).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.network.convolution import convolve, low_convolve
from fusion.detection.network.group_norm import group_norm_relu


class SameConv(nn.Module):
    """3x3 convolution without bias, zeros around the map."""

    features: int
    precision: str = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w f"]:
        """The maps convolved."""
        shape = (3, 3, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape)
        return convolve(x, kernel, self.precision)


class TransposedConv(nn.Module):
    """3x3 transposed convolution of stride 2, as one 2x2 convolution with four outputs a pixel.

    Output pixel (2i + a, 2j + b) sums kernel[m, n] x[i', j'] over 2i' + m - 1 = 2i + a, likewise
    for columns: one tap for a = 0 and two for a = 1. The same function as a dilated convolution,
    which CPU backends run without their fast kernels.
    """

    features: int
    precision: str = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h2 w2 f"]:
        """Double both sides."""
        b, h, w, c = x.shape
        f = self.features
        kernel = self.param("kernel", nn.initializers.he_normal(), (3, 3, c, f))
        bias = self.param("bias", nn.initializers.zeros, (f,))
        # along[m, t, a]: tap m of the kernel reads input i + t for output phase a.
        along = jnp.zeros((3, 2, 2)).at[jnp.array([1, 2, 0]), jnp.array([0, 0, 1]),
                                        jnp.array([0, 1, 1])].set(1.0)  # fmt: skip
        phases = jnp.einsum("mta,nub,mncf->tucabf", along, along, kernel)
        padded = jnp.pad(x, ((0, 0), (0, 1), (0, 1), (0, 0)))
        phases = phases.reshape(2, 2, c, 4 * f)
        if self.precision == "bfloat16":
            y = low_convolve(padded, phases, 0)
        else:
            y = jax.lax.conv_general_dilated(
                padded, phases, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
        y = y.reshape(b, h, w, 2, 2, f).transpose(0, 1, 3, 2, 4, 5)
        return y.reshape(b, 2 * h, 2 * w, f) + bias[None, None, None]


class _Block(nn.Module):
    """3x3 convolution, normalization, ReLU."""

    features: int
    norm: str
    precision: str

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        x = SameConv(self.features, self.precision, name="conv")(x)
        return _normalize_relu(self.norm, x, train)


class _GroupNormRelu(nn.Module):
    @nn.compact
    def __call__(self, x: Array) -> Array:
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        return group_norm_relu(x, scale, self.param("bias", nn.initializers.zeros, x.shape[-1:]))


def _normalize_relu(norm: str, x: Array, train: bool) -> Array:
    """Inside a compact method: normalization of this kind, called `norm`, and ReLU."""
    if norm == "batch":
        layer = nn.BatchNorm(use_running_average=not train, momentum=0.99, name="norm")
        return nn.relu(layer(x))
    return _GroupNormRelu(name="norm")(x)


def _halve(x: Array, axis: int) -> Array:
    """Maxima of neighbours along one axis.

    Not a reduction: with one, the loss of the preset `small` is NaN within ten steps on a CPU. A
    likely cause: its gradient divides by the number of elements that equal the maximum, which is
    zero where the compiler computes them once more with other rounding.
    """
    pairs = x.reshape(*x.shape[:axis], -1, 2, *x.shape[axis + 1 :])
    first, second = (jax.lax.index_in_dim(pairs, i, axis + 1, keepdims=False) for i in (0, 1))
    return jnp.maximum(first, second)


class FeaturePyramid(nn.Module):
    """Maps of the resolution of the input and `widths[0]` channels.

    Level i has `layers[i]` convolutions of `widths[i]` channels; maxima over 2x2 cells lead to the
    next one. On the way back each level is doubled, joined with the encoder's map of its size and
    mixed by a convolution. Sides that do not divide are padded with zeros and cut again, as AVOD
    pads 700 rows to 704.
    """

    widths: tuple[int, ...]
    layers: tuple[int, ...]
    norm: str
    precision: str = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], train: bool) -> Float[Array, "b h w f"]:
        """Features of a batch of maps."""
        height, width = x.shape[1:3]
        step = 2 ** (len(self.widths) - 1)
        x = jnp.pad(x, ((0, 0), (0, -height % step), (0, -width % step), (0, 0)))
        skips: list[Array] = []
        for level, (features, n) in enumerate(zip(self.widths, self.layers, strict=True)):
            if level:
                skips.append(x)
                x = _halve(_halve(x, 1), 2)
            for i in range(n):
                block = _Block(features, self.norm, self.precision, name=f"encoder{level}_{i}")
                x = block(x, train)
        for level in reversed(range(len(skips))):
            up = TransposedConv(self.widths[level], self.precision, name=f"up{level}")(x)
            up = _UpNorm(self.norm, name=f"up_norm{level}")(up, train)
            joined = jnp.concatenate([up, skips[level]], axis=-1)
            mixed = self.widths[max(level - 1, 0)]
            block = _Block(mixed, self.norm, self.precision, name=f"decoder{level}")
            x = block(joined, train)
        return x[:, :height, :width]


class _UpNorm(nn.Module):
    norm: str

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        return _normalize_relu(self.norm, x, train)
