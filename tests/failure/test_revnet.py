import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failure import revnet


def trained(dim, depth, width, seed, dtype):
    """Weights as large as training makes them, not the small ones of the start."""
    key = jax.random.key(seed)
    params = revnet.init(key, dim, depth=depth, width=width, scale=1.0, dtype=dtype)
    noise = jax.random.normal(jax.random.fold_in(key, 1), params.b1.shape, dtype)
    return params._replace(b1=0.5 * noise, b2=-0.3 * noise)


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(
    dim=st.integers(2, 9), depth=st.integers(1, 6), width=st.integers(1, 7), seed=st.integers(0, 99)
)
def test_inverse_is_exact_for_every_size(dim, depth, width, seed):
    with jax.enable_x64(True):
        for dtype, tolerance in ((jnp.float32, 1e-5), (jnp.float64, 1e-12)):
            params = trained(dim, depth, width, seed, dtype)
            x = jax.random.normal(jax.random.key(seed), (3, dim), dtype)
            z = revnet.forward_stored(params, x)
            assert z.shape == x.shape and z.dtype == dtype
            assert float(jnp.max(jnp.abs(revnet.inverse(params, z) - x))) <= tolerance


@pytest.mark.parametrize("scale", [1.0, 8.0, 64.0])
def test_the_inverse_error_at_extreme_weights_stays_below_its_bound(scale):
    """A hundred times what training makes: what is lost is known beforehand."""
    with jax.enable_x64(True):
        for dtype in (jnp.float32, jnp.float64):
            params = trained(8, 4, 4, 0, dtype)
            params = params._replace(k1=scale * params.k1, k2=scale * params.k2)
            x = 3.0 * jax.random.normal(jax.random.key(1), (16, 8), dtype)
            back = revnet.inverse(params, revnet.forward_stored(params, x))
            error = np.linalg.norm(np.asarray(back - x, np.float64), axis=1)
            bound = revnet.inverse_error_bound(params, x)
            assert np.all(np.isfinite(error)) and np.all(error <= bound)
            if scale == 1.0:
                assert bound.max() < 1e6 * float(jnp.finfo(dtype).eps)
            # Numbers as large as a drive makes them lose their last digits, not more.
            size = float(jnp.max(jnp.abs(revnet.forward_stored(params, x))))
            assert error.max() <= 1e3 * size * float(jnp.finfo(dtype).eps)


def test_one_block_is_equation_4_4():
    with jax.enable_x64(True):
        params = trained(6, 1, 5, 0, jnp.float64)
        x = jax.random.normal(jax.random.key(1), (6,), jnp.float64)
        u, v, h = np.asarray(x[:3]), np.asarray(x[3:]), 0.25
        k1, b1, k2, b2 = (np.asarray(leaf[0]) for leaf in params[:4])
        u = u + h * k1.T @ np.tanh(k1 @ v + b1)
        v = v - h * k2.T @ np.tanh(k2 @ u + b2)
        np.testing.assert_allclose(revnet.forward(params, x), np.concatenate([u, v]), rtol=1e-12)


@pytest.mark.parametrize("dim", [6, 7])
def test_recomputed_gradient_is_the_stored_one(dim):
    with jax.enable_x64(True):
        params = trained(dim, 5, 4, 2, jnp.float64)
        x = jax.random.normal(jax.random.key(3), (4, dim), jnp.float64)

        def loss(f, params, x):
            return jnp.sum(jnp.sin(f(params, x)))

        ours = jax.jit(jax.grad(lambda p, x: loss(revnet.forward, p, x), (0, 1)))(params, x)
        theirs = jax.jit(jax.grad(lambda p, x: loss(revnet.forward_stored, p, x), (0, 1)))(
            params, x
        )
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def peak(forward, depth):
    """Temporary memory of the compiled gradient, in bytes."""
    params = jax.eval_shape(lambda: revnet.init(jax.random.key(0), 60, depth=depth))
    x = jax.ShapeDtypeStruct((2048, 60), jnp.float32)
    grad = jax.jit(jax.grad(lambda p, x: jnp.sum(forward(p, x) ** 2)))
    return grad.lower(params, x).compile().memory_analysis().temp_size_in_bytes


def test_memory_does_not_grow_with_depth():
    shallow, deep = peak(revnet.forward, 8), peak(revnet.forward, 64)
    assert deep <= 1.1 * shallow
    # the usual reverse rule keeps every block's activations
    assert peak(revnet.forward_stored, 64) > 5 * deep


def test_bad_sizes():
    with pytest.raises(ValueError, match="dim=1"):
        revnet.init(jax.random.key(0), 1)
    with pytest.raises(ValueError, match="at least 1 block"):
        revnet.init(jax.random.key(0), 4, depth=0)
    with pytest.raises(ValueError, match="input of 6 dimensions for a network of 3 or 4"):
        revnet.forward(revnet.init(jax.random.key(0), 4), jnp.zeros(6))
