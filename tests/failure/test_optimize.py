import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from failure.models.domains import ball, box, sample
from failure.models.optimize import bfgs, polish


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def rosenbrock(x):
    return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


def with_aux(f):
    return lambda x: (*jax.value_and_grad(f)(x), x[0])


def free(dim):
    return box(jnp.full((dim,), -jnp.inf), jnp.full((dim,), jnp.inf))


def test_rosenbrock_to_its_minimum():
    end = bfgs(
        with_aux(rosenbrock), jnp.asarray([-1.2, 1.0, 0.5]), free(3), max_evals=300, ftol=0.0
    )
    np.testing.assert_allclose(end.x, 1.0, atol=1e-5)
    assert bool(end.converged) and float(end.aux) == float(end.x[0])
    assert int(end.n_evals) < 150


def test_bounds_give_the_minimum_of_scipy():
    lower, upper = np.array([-2.0, -2.0, 0.0]), np.array([0.5, 2.0, 0.2])
    x0 = np.array([0.2, 1.0, 0.1])
    end = bfgs(
        with_aux(rosenbrock), jnp.asarray(x0), box(jnp.asarray(lower), jnp.asarray(upper)),
        max_evals=300, ftol=0.0,
    )  # fmt: skip
    other = minimize(
        lambda x: float(rosenbrock(jnp.asarray(x))), x0, method="L-BFGS-B",
        jac=lambda x: np.asarray(jax.grad(rosenbrock)(jnp.asarray(x))),
        bounds=list(zip(lower, upper, strict=True)), options={"ftol": 1e-15, "gtol": 1e-10},
    )  # fmt: skip
    np.testing.assert_allclose(end.value, other.fun, rtol=1e-7)
    assert np.all(np.asarray(end.x) >= lower) and np.all(np.asarray(end.x) <= upper)


def test_minimum_on_a_sphere():
    target = jnp.asarray([2.0, 1.0, -2.0])
    scale = jnp.asarray([1.0, 4.0, 1.0])

    def f(x):
        return jnp.sum(scale * (x - target) ** 2)

    end = bfgs(with_aux(f), jnp.zeros(3), ball(3, 1.0), max_evals=200, ftol=0.0)
    assert np.isclose(np.linalg.norm(end.x), 1.0)
    # at the optimum the gradient is radial (Lagrange)
    grad = np.asarray(jax.grad(f)(end.x))
    cosine = -grad @ np.asarray(end.x) / np.linalg.norm(grad)
    assert cosine > 1 - 1e-6


def test_lanes_stop_on_their_own_and_equal_single_runs():
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)))

    def run(x):
        return bfgs(with_aux(rosenbrock), x, free(2), max_evals=200)

    many = jax.jit(jax.vmap(run))(starts)
    alone = [jax.jit(run)(start) for start in starts]
    np.testing.assert_array_equal(many.n_evals, [r.n_evals for r in alone])
    np.testing.assert_allclose(many.x, jnp.stack([r.x for r in alone]), rtol=1e-8)
    assert len(set(np.asarray(many.n_evals).tolist())) > 1


def test_values_that_are_not_finite_shorten_the_step():
    def f(x):
        return jnp.where(x[0] < 1.0, -jnp.log1p(-jnp.minimum(x[0], 0.999999)) - 3.0 * x[0], jnp.nan)

    end = bfgs(with_aux(f), jnp.zeros(1), free(1), max_evals=60)
    np.testing.assert_allclose(end.x, 2.0 / 3.0, atol=1e-4)


def test_uniform_points_of_a_ball_have_the_known_mean_radius():
    points = sample(ball(5, 2.0), 4000, key=jax.random.key(0))
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() <= 2.0 + 1e-12
    # E|x| = r d / (d + 1)
    assert abs(radius.mean() - 2.0 * 5 / 6) < 0.02


def test_polish_reaches_the_constrained_minimum_to_the_last_digit():
    """A bent, badly scaled function whose minimum in the first coordinate is cut off by a bound."""

    def value(x):
        return 50.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2 + 0.1 * (x[2] - 2.0) ** 4

    with jax.enable_x64(True):
        domain = box(jnp.full(3, -1.5), jnp.asarray([0.5, 1.5, 1.5]))
        start = jnp.asarray([0.1, 0.3, 0.0])
        x, end = jax.jit(lambda x: polish(value, x, domain, steps=12))(start)
    np.testing.assert_allclose(x, [0.5, 0.25, 1.5], atol=1e-9)
    assert float(end) <= float(value(start))
