import json
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure.models import gp, gp_fit
from failure.models.acquisition import log_ei
from failure.models.kernels import KERNELS

TOLERANCE = 1e-8


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def case_params(case):
    return gp.GPParams(
        jnp.log(jnp.asarray(case["lengthscale"])),
        jnp.log(jnp.asarray(case["noise"] - 1e-4)),
        jnp.asarray(case["mean"]),
    )


def padded(case, size=20):
    x, y = np.asarray(case["x"]), np.asarray(case["y"])
    n, dim = x.shape
    # rubbish in the padding must not matter
    px, py = np.full((size, dim), 7.0), np.full(size, -3.0)
    px[:n], py[:n] = x, y
    return jnp.asarray(px), jnp.asarray(py), jnp.asarray(n, jnp.int32)


@partial(jax.jit, static_argnums=0)
def _posterior_at(config, params, data, x_new):
    return gp.predict(config, gp.condition(config, params, *data), x_new)


def posterior_at(config, params, data, case):
    return _posterior_at(config, params, data, jnp.asarray(case["x_new"]))


@pytest.fixture(scope="module")
def botorch_cases(golden):
    cases = json.loads((golden / "failure_gp.json").read_text())["cases"]
    return {case["kernel"]: case for case in cases}


@pytest.mark.parametrize("kernel", KERNELS)
def test_evidence_posterior_and_gradients_are_those_of_botorch(botorch_cases, kernel):
    case = botorch_cases[kernel]
    config, params = gp.GPConfig(kernel=kernel), case_params(case)
    data = padded(case)
    evidence, grad = jax.value_and_grad(lambda p: gp_fit.log_marginal_likelihood(config, p, *data))(
        params
    )
    np.testing.assert_allclose(evidence, case["log_marginal_likelihood"], rtol=TOLERANCE)
    mean, variance = posterior_at(config, params, data, case)
    np.testing.assert_allclose(mean, case["posterior_mean"], rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(variance, case["posterior_variance"], rtol=TOLERANCE, atol=1e-9)
    value = log_ei(mean, jnp.sqrt(variance), jnp.max(jnp.asarray(case["y"])))
    np.testing.assert_allclose(value, case["log_ei"], rtol=1e-7)
    n = len(case["y"])
    if kernel == "linear":
        # botorch's linear kernel carries no lengthscale prior: compare the evidence's gradient
        by_length = grad.log_lengthscale / n
    else:
        objective, grad = jax.jit(
            jax.value_and_grad(lambda p: gp_fit.map_objective(config, p, *data))
        )(params)
        np.testing.assert_allclose(objective, case["map_objective"], rtol=TOLERANCE)
        by_length = grad.log_lengthscale
        by_noise = grad.log_noise / (case["noise"] - 1e-4)
        np.testing.assert_allclose(by_noise, case["grad_noise"], rtol=TOLERANCE)
    np.testing.assert_allclose(
        by_length, case["grad_log_lengthscale"], rtol=TOLERANCE, atol=TOLERANCE
    )


@pytest.mark.relaxed
@pytest.mark.slow
def test_matern_and_rbf_are_those_of_tinygp(botorch_cases):
    from tinygp import GaussianProcess, kernels, transforms

    for name, kernel in (("matern52", kernels.Matern52()), ("rbf", kernels.ExpSquared())):
        case = botorch_cases[name]
        config, params = gp.GPConfig(kernel=name), case_params(case)
        x, y, x_new = (jnp.asarray(case[k]) for k in ("x", "y", "x_new"))
        if name == "matern52":
            # tinygp's stationary kernels measure the L1 distance unless told otherwise
            kernel = kernels.Matern52(distance=kernels.distance.L2Distance())
        scale = jnp.asarray(case["lengthscale"])
        other = GaussianProcess(
            transforms.Linear(1.0 / scale, kernel), x, diag=case["noise"], mean=case["mean"]
        )
        conditioned = other.condition(y, x_new)
        data = padded(case)
        np.testing.assert_allclose(
            gp_fit.log_marginal_likelihood(config, params, *data), other.log_probability(y),
            rtol=TOLERANCE,
        )  # fmt: skip
        mean, variance = posterior_at(config, params, data, case)
        np.testing.assert_allclose(mean, conditioned.gp.loc, rtol=TOLERANCE, atol=TOLERANCE)
        np.testing.assert_allclose(variance, conditioned.gp.variance, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_closed_form_gradient_is_that_of_autodiff(botorch_cases, kernel):
    case = botorch_cases[kernel]
    config, data = gp.GPConfig(kernel=kernel), padded(case)
    params = case_params(case)
    theta = jnp.concatenate([params.log_lengthscale, params.log_noise[None]])
    value, grad, mean = gp_fit.map_value_and_grad(config, theta, *data)

    def objective(theta, mean):
        return -gp_fit.map_objective(config, gp.GPParams(theta[:-1], theta[-1], mean), *data)

    by_theta, by_mean = jax.grad(objective, (0, 1))(theta, mean)
    np.testing.assert_allclose(value, objective(theta, mean), rtol=1e-12)
    np.testing.assert_allclose(grad, by_theta, rtol=TOLERANCE, atol=1e-12)
    # the profiled mean is the best one
    assert abs(float(by_mean)) < 1e-10


@pytest.mark.parametrize("kernel", ["matern52", "linear"])
def test_a_point_appended_is_a_point_conditioned_on(botorch_cases, kernel):
    case = botorch_cases[kernel]
    config, params = gp.GPConfig(kernel=kernel), case_params(case)
    x, y, n = padded(case)
    start = gp.condition(config, params, x, y, n - 3)
    grown = start
    for row in range(int(n) - 3, int(n)):
        grown = gp.append(config, grown, x[row], y)
    full = gp.condition(config, params, x, y, n)
    assert int(grown.n) == int(n)
    # the rank-one factor is not the Cholesky factor's rounding, only its value
    chex.assert_trees_all_close(grown.linv, full.linv, rtol=1e-9, atol=1e-9)
    chex.assert_trees_all_close(grown.alpha, full.alpha, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_fit_recovers_the_relevant_coordinates_and_warm_starts_cost_little():
    rng = np.random.default_rng(0)
    dim, n, size = 6, 60, 64
    x = np.zeros((size, dim))
    x[:n] = rng.uniform(-0.5, 0.5, (n, dim))
    y = np.sin(6 * x[:, 0]) + 2 * x[:, 1] ** 2
    config = gp.GPConfig()
    fit = jax.jit(partial(gp_fit.fit, config))
    scaled, _, _ = gp.standardize(jnp.asarray(y), (jnp.arange(size) < n).astype(jnp.float64))
    start, eye = gp_fit.initial_params(config, dim), jnp.eye(dim + 1)
    count = jnp.asarray(n, jnp.int32)
    cold = fit(start, jnp.asarray(x), scaled, count, eye, jnp.asarray(True))
    warm = fit(cold.params, jnp.asarray(x), scaled, count, cold.hessian_inverse, jnp.asarray(False))
    assert bool(cold.converged) and cold.n_evals > 8
    assert warm.n_evals <= 4 and warm.value >= cold.value - 1e-6
    lengthscale = np.exp(np.asarray(cold.params.log_lengthscale))
    assert lengthscale[:2].max() < 0.3 * lengthscale[2:].min()
    theta = jnp.concatenate([cold.params.log_lengthscale, cold.params.log_noise[None]])
    _, grad, _ = gp_fit.map_value_and_grad(config, theta, jnp.asarray(x), scaled, count)
    assert float(jnp.max(jnp.abs(grad))) < 1e-3


def test_one_program_serves_every_count():
    config = gp.GPConfig()
    predict = jax.jit(
        chex.assert_max_traces(
            lambda x, y, n: gp.predict(
                config, gp.condition(config, gp_fit.initial_params(config, 2), x, y, n), x
            ),
            n=1,
        )
    )
    x = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (8, 2)))
    for n in range(2, 8):
        mean, variance = predict(x, x[:, 0], jnp.asarray(n, jnp.int32))
        assert np.all(np.isfinite(mean)) and np.all(np.asarray(variance) > 0)


def test_a_fit_that_goes_on_from_its_own_result_is_the_same_program():
    """Weakly typed first parameters had every search compile its fit a second time."""
    config = gp.GPConfig()
    x = jax.random.normal(jax.random.key(0), (16, 2))
    program = jax.jit(partial(gp_fit.fit, config, max_evals=2))
    args = x, x[:, 0], jnp.asarray(16, jnp.int32)
    first = program(gp_fit.initial_params(config, 2), *args, jnp.eye(3), jnp.ones((), bool))
    program(first.params, *args, first.hessian_inverse, jnp.zeros((), bool))
    assert program._cache_size() == 1


def test_standardize_ignores_padding_and_survives_constant_data():
    mask = jnp.asarray([1.0, 1.0, 1.0, 0.0])
    y, mean, sd = gp.standardize(jnp.asarray([1.0, 2.0, 3.0, 99.0]), mask)
    np.testing.assert_allclose(y, [-1.0, 0.0, 1.0, 0.0])
    assert float(mean) == 2.0 and float(sd) == 1.0
    y, _, _ = gp.standardize(jnp.asarray([5.0, 5.0, 5.0, 0.0]), mask)
    np.testing.assert_allclose(y, 0.0)
    # femtoamperes are not constant data
    y, _, sd = gp.standardize(1e-15 * jnp.asarray([1.0, 2.0, 3.0, 99.0]), mask)
    np.testing.assert_allclose(y, [-1.0, 0.0, 1.0, 0.0])
    assert np.isclose(float(sd), 1e-15, rtol=1e-9)


def test_bad_configurations():
    with pytest.raises(ValueError, match="expected one of matern52, rbf, linear"):
        gp.GPConfig(kernel="matern")
    with pytest.raises(ValueError, match="min_noise=0"):
        gp.GPConfig(min_noise=0.0)
