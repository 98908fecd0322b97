"""Rays and moving discs against shapely and against closed forms; polygons that are none."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from jaxsnn import geometry

TRIANGLE = [(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)]
ELL = [(0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0)]


def f32(*values: float) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


def sides(polygon: list[tuple[float, float]]) -> jax.Array:
    return jnp.asarray(geometry.polygon_segments(polygon), jnp.float32)


def test_ray_hits_a_side_at_the_known_distance() -> None:
    t = geometry.ray_segments(f32(-1.0, 1.0), f32(1.0, 0.0), sides(TRIANGLE))
    # The left side at 1, the slanted one where x = 4 (1 - y / 3); the bottom side is parallel.
    np.testing.assert_allclose(np.sort(t), [1.0, 1.0 + 8.0 / 3.0, np.inf], rtol=1e-6)


def test_ray_behind_or_past_a_segment_misses() -> None:
    segment = f32(1.0, -1.0, 1.0, 1.0)[None]
    assert np.isinf(geometry.ray_segments(f32(0.0, 0.0), f32(-1.0, 0.0), segment))
    assert np.isinf(geometry.ray_segments(f32(0.0, 1.5), f32(1.0, 0.0), segment))


def test_ray_meets_circles() -> None:
    circles = jnp.asarray([[5.0, 0.0, 2.0], [-5.0, 0.0, 2.0], [0.5, 0.0, 1.0], [5.0, 3.0, 2.0]])
    t = geometry.ray_circles(f32(0.0, 0.0), f32(1.0, 0.0), circles)
    np.testing.assert_allclose(t, [3.0, np.inf, 0.0, np.inf])


@pytest.mark.parametrize(
    ("direction", "expected"), [((1.0, 0.0), 7.0), ((-1.0, 0.0), 3.0), ((0.6, 0.8), 5.0)]
)
def test_ray_meets_the_walls(direction: tuple[float, float], expected: float) -> None:
    t = geometry.ray_box(f32(3.0, 1.0), f32(*direction), f32(0.0, 0.0, 10.0, 5.0))
    np.testing.assert_allclose(t, expected, rtol=1e-6)


def test_disc_touches_a_face_and_a_corner_at_the_known_fraction() -> None:
    box = sides([(10.0, -5.0), (20.0, -5.0), (20.0, 5.0), (10.0, 5.0)])
    move = jnp.broadcast_to(f32(20.0, 0.0), (4, 2))
    face = geometry.disc_segment_contact(f32(0.0, 0.0), move, jnp.float32(2.0), box)
    np.testing.assert_allclose(jnp.min(face), 8.0 / 20.0, rtol=1e-6)
    # At y = 6 only the corner (10, 5) is in the way: contact where (x - 10)^2 + 1 = 4.
    corner = geometry.disc_segment_contact(f32(0.0, 6.0), move, jnp.float32(2.0), box)
    np.testing.assert_allclose(jnp.min(corner), (10.0 - 3.0**0.5) / 20.0, rtol=1e-5)
    past = geometry.disc_segment_contact(f32(0.0, 7.5), move, jnp.float32(2.0), box)
    assert np.isinf(past).all()


def test_disc_that_touches_may_leave_but_not_enter() -> None:
    circle, reach = jnp.asarray([[0.0, 0.0]]), f32(5.0)
    inwards = geometry.disc_circle_contact(f32(4.9, 0.0), f32(-1.0, 0.0)[None], circle, reach)
    outwards = geometry.disc_circle_contact(f32(4.9, 0.0), f32(1.0, 0.0)[None], circle, reach)
    assert inwards == 0.0
    assert np.isinf(outwards)


def test_sweep_agrees_with_shapely_for_random_moves() -> None:
    """A contact fraction is where the swept disc first touches; none means it never does."""
    rng = np.random.default_rng(1)
    ell = [(30.0 * x, 30.0 * y) for x, y in ELL]
    shape, box = shapely.Polygon(ell), sides(ell)
    starts = rng.uniform(-80, 170, (400, 2))
    starts = starts[shapely.distance(shape, shapely.points(starts)) > 8.0]
    moves = rng.uniform(-300, 300, starts.shape)  # far longer than the obstacle is thick

    def first(p: jax.Array, d: jax.Array) -> jax.Array:
        each = jnp.broadcast_to(d, (len(ell), 2))
        return jnp.min(geometry.disc_segment_contact(p, each, jnp.asarray(8.0, p.dtype), box))

    contact = np.asarray(
        jax.jit(jax.vmap(first))(jnp.float32(starts), jnp.float32(moves)), np.float64
    )
    whole = shapely.linestrings(np.stack([starts, starts + moves], axis=1))
    gap = shapely.distance(whole, shape)
    clear = np.abs(gap - 8.0) > 1e-3
    assert 30 < np.isfinite(contact).sum() < len(contact) - 30
    np.testing.assert_array_equal(np.isfinite(contact)[clear], (gap < 8.0)[clear])
    hit = np.isfinite(contact) & clear
    at = starts[hit] + contact[hit, None] * moves[hit]
    np.testing.assert_allclose(shapely.distance(shape, shapely.points(at)), 8.0, atol=2e-3)
    until = shapely.linestrings(np.stack([starts[hit], at], axis=1))
    assert (shapely.distance(until, shape) > 8.0 - 2e-3).all()


def test_inside_and_distance_agree_with_shapely() -> None:
    rng = np.random.default_rng(2)
    points, others = rng.uniform(-1, 5, (2, 300, 2))
    shape = shapely.Polygon(ELL)
    np.testing.assert_array_equal(
        geometry.inside_polygon(points, np.asarray(ELL)),
        shapely.contains(shape, shapely.points(points)),
    )
    lines = shapely.linestrings(np.stack([points, others], axis=1))
    distance = geometry.segment_distance(points, others, geometry.polygon_segments(ELL)).min(axis=1)
    np.testing.assert_allclose(distance, shapely.distance(lines, shape.exterior), atol=1e-12)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        ([(0, 0), (1, 1)], "at least three corners"),
        ([(0, 0), (1, 1), (2, 2)], "area 0"),
        ([(0, 0), (1, 0), (1, 0), (0, 1)], r"repeats its corner \[1.0, 0.0\]"),
        ([(0, 0), (3, 2), (3, 0), (0, 1)], "crosses itself"),
        ([(0, 0), (1, 0), (0, float("nan"))], "not finite"),
    ],
)
def test_degenerate_polygons_are_refused(polygon: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        geometry.check_polygon(polygon, "polygon 0")
