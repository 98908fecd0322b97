r"""Where rays from one point first meet a scene: convex bodies on a plane.

A part is the intersection of six half-spaces; along a ray the signed distance to each is linear,

.. math:: f_i(t) = a_i + b_i t \le 0, \qquad
    t_{in} = \max_{b_i < 0} -a_i / b_i, \quad t_{out} = \min_{b_i > 0} -a_i / b_i,

and the ray hits where :math:`0 < t_{in} \le t_{out}`. The offsets :math:`a_i` do not depend on the
ray, as all rays of a sensor start in the same point, so a part costs six divisions a ray. Bodies
are scanned one after the other: memory does not grow with their number.

Source: Kay, Kajiya (1986), the slab method.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.simulator.scene import Scene

GROUND, SKY = -1, -2  # what a ray met when it met no body


class Hits(NamedTuple):
    """What R rays met.

    Attributes:
        distance: `[R]` along the ray, in lengths of its direction; inf for sky.
        body: `[R]` slot of the scene, or `GROUND` or `SKY`.
        part: `[R]` 0 or 1, and `face`: `[R]` 0 bottom, 1 top, 2 front, 3 back, 4 and 5 the sides.
        normal: `[R, 3]` outward unit normal, camera frame.
        alone: `[K]` rays that would meet each body if nothing stood before it.
    """

    distance: Array
    body: Array
    part: Array
    face: Array
    normal: Array
    alone: Array


def to_body(turn: Float[Array, "... 2"], vector: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Turn camera-frame vectors into a body's frame: along its heading, up, across."""
    c, s = turn[..., 0], turn[..., 1]
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    return jnp.stack([x * c - z * s, -y, x * s + z * c], axis=-1)


def _half_spaces(part: Array, o: Array, d: tuple[Array, ...]) -> list[tuple[Array, Array]]:
    """Offset and slope of the six signed distances: at `o`, along `d` (body frame)."""
    h0, h1, x0, x1, x0t, x1t, w, wt = (part[i] for i in range(8))
    rise = jnp.maximum(h1 - h0, 1e-6)
    front, back, side = (x1t - x1) / rise, (x0t - x0) / rise, (wt - w) / rise
    up = o[1] - h0
    along, climb, across = d
    return [
        (h0 - o[1], -climb),
        (o[1] - h1, climb),
        (o[0] - x1 - front * up, along - front * climb),
        (x0 + back * up - o[0], back * climb - along),
        (o[2] - w - side * up, across - side * climb),
        (-o[2] - w - side * up, -across - side * climb),
    ]


def _meet(part: Array, o: Array, d: tuple[Array, ...]) -> tuple[Array, Array]:
    """Distance (inf where the part is missed) and face, `[R]` each."""

    def miss() -> tuple[Array, Array]:
        return jnp.full(d[0].shape, jnp.inf), jnp.zeros(d[0].shape, jnp.int32)

    # Half of the slots are empty; outside of vmap this skips them.
    return jax.lax.cond(part[1] > part[0], lambda: _meet_solid(part, o, d), miss)


def _meet_solid(part: Array, o: Array, d: tuple[Array, ...]) -> tuple[Array, Array]:
    t_in = jnp.full(d[0].shape, -jnp.inf)
    t_out = jnp.full(d[0].shape, jnp.inf)
    face = jnp.zeros(d[0].shape, jnp.int32)
    for i, (a, b) in enumerate(_half_spaces(part, o, d)):
        # A ray along the face: far off in the direction that keeps or loses it.
        slope = jnp.where(jnp.abs(b) < 1e-9, 1e-9, b)
        t = -a / slope
        entering = slope < 0.0
        later = entering & (t > t_in)
        face = jnp.where(later, i, face)
        t_in = jnp.where(later, t, t_in)
        t_out = jnp.where(entering, t_out, jnp.minimum(t_out, t))
    hit = (t_in <= t_out) & (t_in > 0.0)
    return jnp.where(hit, t_in, jnp.inf), face


def _normals(parts: Array, turn: Array, face: Array) -> Array:
    """Outward unit normals `[R, 3]` in the camera frame; `parts` is `[R, 8]`."""
    rise = jnp.maximum(parts[:, 1] - parts[:, 0], 1e-6)
    front = (parts[:, 5] - parts[:, 3]) / rise
    back = (parts[:, 4] - parts[:, 2]) / rise
    side = (parts[:, 7] - parts[:, 6]) / rise
    zero, one = jnp.zeros_like(rise), jnp.ones_like(rise)
    choices = [
        (zero, -one, zero), (zero, one, zero), (one, -front, zero), (-one, back, zero),
        (zero, -side, one), (zero, -side, -one),
    ]  # fmt: skip
    table = jnp.stack([jnp.stack(n, axis=-1) for n in choices])
    n = table[face, jnp.arange(face.shape[0])]
    n = n / jnp.linalg.norm(n, axis=-1, keepdims=True)
    c, s = turn[:, 0], turn[:, 1]
    return jnp.stack([n[:, 0] * c + n[:, 2] * s, -n[:, 1], -n[:, 0] * s + n[:, 2] * c], axis=-1)


def cast(scene: Scene, origin: Float[Array, "3"], directions: Float[Array, "r 3"]) -> Hits:
    """First hits of rays `origin + t directions` (camera frame, directions of any length)."""
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    n_rays = directions.shape[:1]

    def body(carry: tuple[Array, ...], slot: tuple[Array, ...]) -> tuple[Any, Array]:
        best, found, found_face = carry
        index, place, turn, parts = slot
        c, s = turn[0], turn[1]
        o = to_body(turn, origin - place)
        d = (x * c - z * s, -y, x * s + z * c)
        t0, face0 = _meet(parts[0], o, d)
        t1, face1 = _meet(parts[1], o, d)
        second = t1 < t0
        t = jnp.where(second, t1, t0)
        nearer = t < best
        code = 2 * index + second.astype(jnp.int32)
        carry = (
            jnp.where(nearer, t, best),
            jnp.where(nearer, code, found),
            jnp.where(nearer, jnp.where(second, face1, face0), found_face),
        )
        return carry, jnp.isfinite(t).sum()

    start = (
        jnp.full(n_rays, jnp.inf),
        jnp.full(n_rays, 2 * SKY, jnp.int32),
        jnp.zeros(n_rays, jnp.int32),
    )
    slots: Any = (jnp.arange(scene.place.shape[0]), scene.place, scene.turn, scene.parts)
    (best, code, face), alone = jax.lax.scan(body, start, slots)

    plane = jnp.asarray(scene.plane)
    fall = directions @ plane[:3]
    t_ground = -(origin @ plane[:3] + plane[3]) / jnp.where(fall < -1e-9, fall, -1e-9)
    on_ground = (fall < -1e-9) & (t_ground > 0.0) & (t_ground < best)
    best = jnp.where(on_ground, t_ground, best)
    slot = jnp.where(on_ground, GROUND, code // 2)
    held = jnp.maximum(slot, 0)
    normal = _normals(jnp.asarray(scene.parts)[held, code % 2], jnp.asarray(scene.turn)[held], face)
    normal = jnp.where((slot >= 0)[:, None], normal, plane[None, :3])
    return Hits(best, slot, jnp.where(slot >= 0, code % 2, 0), face, normal, alone)
