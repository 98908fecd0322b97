"""What the surfaces of a simulated scene look like: colour, glass, and the lidar's reflectivity.

Colours are functions of the place on a body, so that they cost the same for every kind: windows,
wheels, lamps (white in front, red behind), leaves, corrugated iron, house fronts, lane marks.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from fusion.detection.simulator.raycast import GROUND, SKY, Hits, to_body
from fusion.detection.simulator.scene import KINDS, Scene

_OF = {name: i for i, name in enumerate(KINDS)}
GLASS = (0.13, 0.16, 0.20)
TYRE = (0.06, 0.06, 0.07)
LAMP = (0.95, 0.95, 0.85)
REAR_LAMP = (0.75, 0.06, 0.06)
SKIN = (0.78, 0.58, 0.46)
TRUNK = (0.30, 0.22, 0.15)
MARK = (0.85, 0.85, 0.83)
ROAD_REFLECTIVITY, VERGE_REFLECTIVITY, MARK_REFLECTIVITY = 0.2, 0.35, 0.6


class Surface(NamedTuple):
    """Colour `[R, 3]`, reflectivity `[R]`, whether it is glass `[R]`, where it is `[R, 3]`."""

    colour: Array
    reflectivity: Array
    glass: Array
    point: Array


def _noise(cells: Int[Array, "r"], *more: Int[Array, "r"]) -> Float[Array, "r"]:
    """A fixed number in [0, 1) for every combination of integers (multiply and shift)."""
    x = jnp.zeros(cells.shape, jnp.uint32)
    for value in (cells, *more):
        x = (x ^ value.astype(jnp.uint32)) * jnp.uint32(0x9E3779B1)
        x = (x ^ (x >> jnp.uint32(15))) * jnp.uint32(0x85EBCA6B)
        x = x ^ (x >> jnp.uint32(13))
    return (x >> jnp.uint32(8)).astype(jnp.float32) / jnp.float32(1 << 24)


def _cell(value: Array, size: float) -> Array:
    return jnp.floor(value / size).astype(jnp.int32)


def _ground(scene: Scene, point: Array) -> tuple[Array, Array]:
    """Colour and reflectivity of the ground: road with marks, verge."""
    x, z = point[:, 0], point[:, 2]
    grain = 0.9 + 0.2 * _noise(_cell(x, 0.25), _cell(z, 0.25))
    away = x - scene.road[0]
    road = jnp.abs(away) < scene.road[1]
    lane = jnp.abs(away - 3.5 * jnp.round(away / 3.5))
    dashed = jnp.mod(z, 9.0) < 4.0
    edge = jnp.abs(jnp.abs(away) - scene.road[1] + 0.3) < 0.08
    mark = road & (((lane < 0.08) & dashed) | edge)
    paint = jnp.where(road[:, None], scene.ground_paint[None, 0], scene.ground_paint[None, 1])
    colour = jnp.where(mark[:, None], jnp.array([MARK]), paint * grain[:, None])
    plain = jnp.where(road, ROAD_REFLECTIVITY, VERGE_REFLECTIVITY)
    return colour, jnp.where(mark, MARK_REFLECTIVITY, plain)


def surfaces(
    scene: Scene, hits: Hits, origin: Float[Array, "3"], directions: Float[Array, "r 3"]
) -> Surface:
    """Look up what each hit shows. Sky has the sky's colour and reflects nothing."""
    far = jnp.where(jnp.isfinite(hits.distance), hits.distance, 0.0)
    point = origin[None] + far[:, None] * directions
    slot = jnp.maximum(hits.body, 0)
    kind, paint = jnp.asarray(scene.kind)[slot], jnp.asarray(scene.paint)[slot]
    size = jnp.asarray(scene.size)[slot]
    local = to_body(jnp.asarray(scene.turn)[slot], point - jnp.asarray(scene.place)[slot])
    along, up, across = local[:, 0], local[:, 1], local[:, 2]
    # As shares of the box; -0.5 to 0.5 along and across, 0 to 1 up.
    a, u, c = along / size[:, 2], up / size[:, 0], across / size[:, 1]
    front, back, flank = hits.face == 2, hits.face == 3, hits.face >= 4
    upper = hits.part == 1

    def of(*names: str) -> Array:
        return jnp.isin(kind, jnp.array([_OF[n] for n in names], jnp.int32))

    def put(colour: Array, where: Array, value: tuple[float, ...] | Array) -> Array:
        new = jnp.array([value]) if isinstance(value, tuple) else value
        return jnp.where(where[:, None], new, colour)

    speckle = _noise(_cell(along, 0.2), _cell(up, 0.2), _cell(across, 0.2), slot)
    rib = jnp.mod(along + across, 0.4) < 0.2
    colour = paint
    # Leaves and corrugated iron: no windows, no wheels.
    leaves = of("bush") | (of("tree") & upper)
    colour = jnp.where(leaves[:, None], paint * (0.55 + 0.9 * speckle)[:, None], colour)
    colour = jnp.where((of("container") & rib)[:, None], 0.8 * paint, colour)
    colour = put(colour, of("tree") & ~upper, TRUNK)
    # Road vehicles.
    cabin = (of("Car", "Van") & upper) | (of("Truck") & upper & (u > 0.4))
    pillar = flank & ((jnp.abs(jnp.mod(a + 0.06, 0.24) - 0.12) < 0.012) | (jnp.abs(a) > 0.44))
    glass = cabin & (front | back | flank) & (u > 0.63) & (u < 0.94) & ~pillar
    glass |= of("Tram") & flank & (u > 0.45) & (u < 0.75) & (jnp.mod(along, 2.0) > 0.25)
    colour = put(colour, glass, GLASS)
    vehicle, lower = of("Car", "Van", "Truck", "Misc"), hits.part == 0
    radius = jnp.minimum(0.33, 0.25 * size[:, 0])
    from_axle = jnp.minimum(jnp.abs(a - 0.32), jnp.abs(a + 0.30)) * size[:, 2]
    wheel = vehicle & lower & flank & (jnp.hypot(from_axle, up - radius) < radius)
    sill = vehicle & lower & (u < 0.2)
    colour = put(colour, wheel | sill, TYRE)
    lamp = vehicle & lower & (u > 0.40) & (u < 0.52) & (jnp.abs(c) > 0.30)
    colour = put(colour, lamp & front, LAMP)
    colour = put(colour, lamp & back, REAR_LAMP)
    # People.
    person = of("Pedestrian", "Person_sitting")
    colour = jnp.where((person & (u < 0.48))[:, None], 0.45 * paint, colour)
    colour = put(colour, (of("Pedestrian") & upper) | (of("Cyclist") & (u > 0.86)), SKIN)
    colour = put(colour, of("Cyclist") & lower, TYRE)
    # House fronts.
    pane = (
        (jnp.mod(along + across, 2.5) < 1.2) & (jnp.mod(up, 3.0) > 1.2) & (jnp.mod(up, 3.0) < 2.5)
    )
    colour = put(colour, of("building") & pane & (hits.face >= 2), GLASS)

    # A body in the colour of the road, glass and wheels included, and lit like the road.
    hidden = jnp.where(hits.body >= 0, jnp.asarray(scene.low_contrast)[slot], 0.0)
    blend = 0.95 * hidden[:, None]
    colour = (1.0 - blend) * colour + blend * scene.ground_paint[None, 0]
    normal = (1.0 - blend) * hits.normal + blend * scene.plane[None, :3]
    reflectivity = jnp.asarray(scene.reflectivity)[slot]

    ground_colour, ground_reflectivity = _ground(scene, point)
    on_ground, sky = hits.body == GROUND, hits.body == SKY
    colour = jnp.where(on_ground[:, None], ground_colour, colour)
    reflectivity = jnp.where(on_ground, ground_reflectivity, reflectivity)
    toward_sun = jnp.maximum(normal @ scene.sun, 0.0)
    shade = scene.light[0] + (1.0 - scene.light[0]) * toward_sun
    unit = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
    haze = jnp.clip(1.0 + 2.0 * unit[:, 1], 0.0, 1.0)[:, None]  # paler towards the horizon
    above = scene.sky[None] * (1.0 - haze) + 0.95 * haze
    colour = jnp.where(sky[:, None], above, colour * shade[:, None])
    solid = hits.body >= 0
    return Surface(colour, jnp.where(sky, 0.0, reflectivity), glass & solid, point)
