r"""A one-stage detector on a grid over the ground: camera lifted into it, lidar, one trunk.

.. math:: h = \big[\, 2 w_1 c, \; 2 w_2 l \,\big]

The camera's map is read at every cell (`lift`), the lidar's map is brought to the same cells, both
are scaled by the fusion weights (one half each without a gate) and put side by side. A small
encoder and decoder over the grid ends in eleven numbers a cell: the heat of a car's centre, a box.

Source: Zhou, Wang, Kraehenbuehl (2019), objects as points; Yin, Zhou, Kraehenbuehl (2021),
CenterPoint; the gate, Shim (2020), section 3.3.2.2. Widths are our choice.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.network.detector import teach_if_alive
from fusion.detection.network.group_norm import group_norm_relu
from fusion.detection.network.heads import CleanReadings, GridGate, QualityHead
from fusion.detection.network.initialize import init_weights
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.lifting import lift
from fusion.detection.network.views import SameConv
from fusion.detection.sensors.quality import quality_statistics
from fusion.targets import init_targets

# Heat; x, z, height from the ground; log length, width, height; cos, sin of axis and of heading.
N_OUTPUTS = 11
_RARE = -4.0  # log odds of a centre to begin with
_OUTPUTS = {"fusion": 0.0, "boxes": 0.01}


class Grids(NamedTuple):
    """Of a batch of frames, before fusion.

    Attributes:
        camera, lidar: `[b, r, s, c]` features at the cells.
        weights: `[b, 2]` fusion weights, sum to one.
        failed: `[b, 2]` log odds that the sensor has failed; NaN without a gate that tells.
    """

    camera: Array
    lidar: Array
    weights: Array
    failed: Array


class _Block(nn.Module):
    """Convolution without bias, group norm, ReLU."""

    features: int
    stride: int = 1
    size: int = 3
    precision: str = "float32"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        if self.stride == 1 and self.size == 3:
            y = SameConv(self.features, self.precision, name="conv")(x)
        else:
            sides = (self.size,) * 2, (self.stride,) * 2
            dtype = jnp.dtype(self.precision)
            conv = nn.Conv(self.features, *sides, use_bias=False, dtype=dtype, name="conv")
            y = conv(x).astype(x.dtype)
        scale = self.param("scale", nn.initializers.ones, (self.features,))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return group_norm_relu(y, scale, bias)


class _Output(nn.Module):
    """`N_OUTPUTS` numbers a cell; centres are rare to begin with."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        y = nn.Conv(N_OUTPUTS, (1, 1), name="boxes")(x)
        return y + _RARE * jax.nn.one_hot(0, N_OUTPUTS, dtype=y.dtype)[None, None, None]


def _told(severity: Float[Array, "b 2"]) -> Float[Array, "b 4"]:
    """What the oracle's gate reads in place of log odds: fails or works (+-4), and how severely."""
    flags = jnp.where(severity > 0.0, 4.0, -4.0).astype(severity.dtype)
    return jnp.concatenate([flags, 4.0 * severity], axis=-1)


def _double(x: Array, like: Array) -> Array:
    """Twice the resolution, cut to the size of another map."""
    return x.repeat(2, axis=1).repeat(2, axis=2)[:, : like.shape[1], : like.shape[2]]


class DenseDetector(nn.Module):
    """The main network; use its methods through `apply(..., method=...)`."""

    config: DetectorConfig

    def setup(self) -> None:
        """Views, gate, trunk, head."""
        c, d = self.config, self.config.dense
        stride = round(d.cell / c.bev.cell)
        size = 3 if stride <= 2 else stride + 1 - stride % 2
        block = functools.partial(_Block, precision=c.precision)
        self.lidar = [block(d.lidar_width, stride, size), block(d.lidar_width)]
        half, quarter = d.camera_widths
        self.near = [block(half, 2), block(half)]
        self.wide = [block(quarter, 2), block(quarter)]
        self.joined, self.lifted = block(half), block(half, size=1)
        if c.weighs:
            self.gate = GridGate(c.gate_width, c.normalizer)
            if c.gate_statistics:
                self.clean = CleanReadings()
            if c.gated and c.gate_statistics:
                self.quality = QualityHead()
        top, low = d.trunk_widths
        self.fused = [block(top), block(top)]
        self.down = [block(low, 2), block(low), block(low)]
        self.bottom = [block(low, 2), block(low)]
        self.up = [block(top, size=1), block(top), block(top)]
        self.output = _Output()

    def encode(self, inputs: Inputs) -> Grids:
        """Both views on the grid, and the fusion weights (0.5 each without a gate)."""
        lidar = inputs.bev
        for block in self.lidar:
            lidar = block(lidar)
        near = self.near[1](self.near[0](inputs.image))
        wide = self.wide[1](self.wide[0](near))
        features = self.joined(jnp.concatenate([near, _double(wide, near)], axis=-1))
        at_cells = jax.vmap(lambda f, n, p, s: lift(self.config, f, n, p, s))
        camera = self.lifted(at_cells(features, inputs.plane, inputs.p2, inputs.image_size))
        camera = teach_if_alive(camera, inputs.image)
        lidar = teach_if_alive(lidar, inputs.bev)
        b = camera.shape[0]
        failed = jnp.full((b, 2), jnp.nan)
        if self.config.fixed_weights is not None:
            fixed = jnp.asarray(self.config.fixed_weights, jnp.float32)
            return Grids(camera, lidar, jnp.broadcast_to(fixed[None], (b, 2)), failed)
        if not self.config.weighs:
            return Grids(camera, lidar, jnp.full((b, 2), 0.5), failed)
        # The gate reads the views and does not train them.
        views = jax.lax.stop_gradient((camera, lidar))
        away: tuple[Array, ...] = ()
        if self.config.gate_statistics:
            away = self.clean(quality_statistics(self.config.bev, inputs.image, inputs.bev))
        if self.config.is_oracle:
            weights = self.gate(views, _told(inputs.told), away)
            return Grids(camera, lidar, weights, failed)
        if not away:
            return Grids(camera, lidar, self.gate(views), failed)
        failed = self.quality(away)
        return Grids(camera, lidar, self.gate(views, failed), failed)

    def head(self, grids: Grids, scale: Float[Array, "b 2"]) -> Float[Array, "b r s 11"]:
        """Heat (log odds) and box of every cell from the scaled views."""
        factor = scale[:, :, None, None, None]
        x = jnp.concatenate([factor[:, 0] * grids.camera, factor[:, 1] * grids.lidar], axis=-1)
        for block in self.fused:
            x = block(x)
        y = x
        for block in self.down:
            y = block(y)
        y = y + _double(self.bottom[1](self.bottom[0](y)), y)
        x = x + _double(self.up[0](y), x)
        return self.output(self.up[2](self.up[1](x)))

    def __call__(self, inputs: Inputs) -> Array:
        """Touch every parameter once (for `init`)."""
        grids = self.encode(inputs)
        return self.head(grids, 2.0 * grids.weights)


class DenseAuxiliary(nn.Module):
    """A head for each view, on that view's grid alone (training only)."""

    config: DetectorConfig

    @nn.compact
    def __call__(self, camera: Array, lidar: Array) -> tuple[Array, Array]:
        """Outputs of each view `[b, r, s, 11]`."""
        top = self.config.dense.trunk_widths[0]
        found = []
        for sensor, x in (("camera", camera), ("lidar", lidar)):
            for i in range(2):
                x = _Block(top, precision=self.config.precision, name=f"{sensor}{i}")(x)
            found.append(_Output(name=f"{sensor}_output")(x))
        return found[0], found[1]


def _shapes(config: DetectorConfig) -> Inputs:
    """Shapes of a batch of one frame, as far as the network reads it."""

    def of(*sides: int) -> Any:  # lazy initialisation takes shapes for arrays
        return jax.ShapeDtypeStruct((1, *sides), jnp.float32)

    none = of(1)
    return Inputs(
        image=of(*config.image_size, 3), bev=of(*config.bev.shape, config.bev.n_slices + 1),
        anchors=none, anchor_mask=none, n_occupied=none, p2=of(3, 4), image_size=of(2),
        plane=of(4), truth=none, truth_mask=none, ignored=none, regions=none,
        told=of(2),
    )  # fmt: skip


def init_dense(key: PRNGKeyArray, config: DetectorConfig) -> tuple[Any, Any]:
    """Fresh parameters, as `init_avod` makes them, and no statistics."""
    main_key, aux_key, target_key = jax.random.split(key, 3)
    shapes = _shapes(config)
    main = init_weights(main_key, DenseDetector(config), shapes, scales=_OUTPUTS)
    params: dict[str, Any] = {"main": main["params"]}
    if config.gated:
        d, stride = config.dense, round(config.dense.cell / config.bev.cell)
        sides = tuple(n // stride for n in config.bev.shape)
        views = [
            jax.ShapeDtypeStruct((1, *sides, width), jnp.float32)
            for width in (d.camera_widths[0], d.lidar_width)
        ]
        heads = init_weights(aux_key, DenseAuxiliary(config), *views, scales=_OUTPUTS)
        params["auxiliary"] = heads["params"]
        params["targets"] = init_targets(target_key, config.targets, 2)
        params["mean_losses"] = jnp.full(2, math.log(2.0), jnp.float32)
    return params, {}
