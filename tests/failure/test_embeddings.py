import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import revnet
from failure.search import spaces
from failure.search.task import Task, task_domain

BOX, BALL = Task("box", 3.0, 6), Task("ball", 4.0, 6)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def full(task):
    return spaces.FullSpace(jnp.asarray(spaces.unit_scale(task)))


@pytest.mark.parametrize("task", [BOX, BALL])
def test_unit_coordinates_have_the_variance_of_a_unit_cube(task):
    u = spaces.initial_design(full(task), task, 20_000, key=jax.random.key(0))
    np.testing.assert_allclose(np.var(u, axis=0), 1 / 12, rtol=0.05)
    x, clipped = full(task).decode(task_domain(task), u[0])
    assert float(clipped) == 0.0
    np.testing.assert_allclose(full(task).encode(x), u[0], rtol=1e-12)


def test_random_embedding_is_the_clipped_linear_map():
    space = spaces.random_embedding(BOX, 2, key=jax.random.key(0))
    domain = task_domain(BOX)
    u = jnp.asarray([0.1, -0.05])
    z = 2 * np.sqrt(2) * np.asarray(u)
    raw = 3.0 * np.asarray(space.matrix) @ z
    x, share = space.decode(domain, u)
    np.testing.assert_allclose(x, np.clip(raw, -3, 3), rtol=1e-12)
    np.testing.assert_allclose(share, np.mean(np.abs(raw) > 3))
    # u = 1/2 is the edge z = sqrt(d) of the source's cube
    assert np.isclose(2 * np.sqrt(2) * 0.5, np.sqrt(2))
    with pytest.raises(ValueError, match="expected a space with an inverse"):
        space.encode(x)
    with pytest.raises(ValueError, match="embedding_dim=7"):
        spaces.random_embedding(BOX, 7, key=jax.random.key(0))


@pytest.mark.parametrize("task", [BOX, BALL])
def test_slope_of_decode_agrees_with_differences(task):
    space = spaces.random_embedding(task, 2, key=jax.random.key(0))
    domain = task_domain(task)
    # the first point clips some coordinates of the box, and leaves the ball
    for u in (jnp.asarray([0.31, -0.24]), jnp.asarray([0.02, -0.03])):
        decode = jax.jit(lambda u: space.decode(domain, u)[0])
        slope = jax.jacrev(decode)(u)
        step = 1e-6 * jnp.eye(2)
        differences = [(decode(u + h) - decode(u - h)) / 2e-6 for h in step]
        np.testing.assert_allclose(slope, jnp.stack(differences, 1), rtol=1e-6, atol=1e-6)


def reversed_space(order, n_active):
    network = revnet.init(jax.random.key(1), 6, depth=3, scale=1.0, dtype=jnp.float64)
    return spaces.ReversedFeatures(
        network, jnp.asarray(order), jnp.full((n_active,), 0.1), jnp.full((n_active,), 2.0),
        jnp.asarray(1.5), None,
    )  # fmt: skip


def test_reversed_features_put_zeros_into_the_inactive_ones():
    space = reversed_space([4, 0, 2, 1, 3, 5], 2)
    domain = task_domain(Task("box", 50.0, 6))
    u = jnp.asarray([0.3, -0.2])
    x, clipped = space.decode(domain, u)
    z = np.asarray(revnet.forward(space.network, x / 1.5))
    np.testing.assert_allclose(z[[4, 0]], 0.1 + 2.0 * np.asarray(u), atol=1e-12)
    np.testing.assert_allclose(z[[2, 1, 3, 5]], 0.0, atol=1e-12)
    assert float(clipped) == 0.0
    np.testing.assert_allclose(space.encode(x), u, atol=1e-12)


def test_all_features_active_give_any_x_back():
    space = reversed_space([4, 0, 2, 1, 3, 5], 6)
    x = jnp.asarray([0.5, -2.0, 1.0, 0.0, 2.5, -1.0])
    u = space.encode(x)
    back, clipped = space.decode(task_domain(BOX), u)
    np.testing.assert_allclose(back, x, atol=1e-10)
    assert float(clipped) == 0.0


def test_a_restored_point_outside_the_set_is_projected_and_reported():
    space = reversed_space([0, 1, 2, 3, 4, 5], 2)
    u = jnp.asarray([40.0, -40.0])
    x, clipped = space.decode(task_domain(BOX), u)
    assert np.all(np.abs(x) <= 3.0) and float(clipped) > 0.0
    x, clipped = space.decode(task_domain(BALL), u)
    assert np.isclose(np.linalg.norm(x), 4.0) and float(clipped) == 1.0


def test_bad_tasks():
    with pytest.raises(ValueError, match="kind='sphere': expected 'box' or 'ball'"):
        Task("sphere", 1.0, 3)
    with pytest.raises(ValueError, match=r"size=-1\.0: expected a positive number of sigma"):
        Task("box", -1.0, 3)
    with pytest.raises(ValueError, match="dim=0"):
        Task("box", 1.0, 0)
