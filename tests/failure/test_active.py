import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import active, plots, revnet
from failure.rev_argate import RevArgateConfig, init

DIM = 6
NAMES = [("M1", "length"), ("M1", "width"), ("M2", "length"), ("M2", "width"), ("M3", "length"),
         ("M3", "width")]  # fmt: skip


@pytest.mark.slow
def test_a_network_that_moves_nothing_points_at_its_own_parameter(tmp_path):
    """With K = 0 the features are the parameters, so the weights pass through unchanged."""
    config = RevArgateConfig(depth=2, feature_width=2, gate_width=4)
    params = init(jax.random.key(0), config, DIM)
    network = params.network._replace(
        k1=jnp.zeros_like(params.network.k1), k2=jnp.zeros_like(params.network.k2)
    )
    gate = jax.tree.map(lambda w: w + 0.3 * jax.random.normal(jax.random.key(1), w.shape),
                        params.gate)  # fmt: skip
    params = params._replace(network=network, gate=gate)
    x = jax.random.normal(jax.random.key(2), (32, DIM))
    found = active.activity(config, params, x, share=0.5)
    np.testing.assert_allclose(found.sensitivity, np.eye(DIM), atol=1e-6)
    np.testing.assert_allclose(found.parameters, found.weights, atol=1e-6)
    assert found.weights[found.order[0]] == found.weights.max() > 1.01 * found.weights.min()
    shares = active.by_transistor(NAMES, found.parameters)
    assert abs(sum(shares.values()) - 1.0) < 1e-6
    plots.plot_shares(shares, title="shares").savefig(tmp_path / "shares.png")
    assert (tmp_path / "shares.png").stat().st_size > 1000


def test_sensitivity_is_the_slope_of_the_inverse():
    config = RevArgateConfig(depth=3, feature_width=2, gate_width=4)
    params = init(jax.random.key(3), config, DIM)
    x = jax.random.normal(jax.random.key(4), (1, DIM))
    found = active.activity(config, params, x)
    z, h = revnet.forward(params.network, x[0]), 1e-2
    rows = []
    for k in range(DIM):
        step = jnp.zeros(DIM).at[k].set(h)
        up, down = (revnet.inverse(params.network, z + s * step) for s in (1.0, -1.0))
        rows.append(np.abs(np.asarray(up - down)))
    slopes = np.stack(rows)
    np.testing.assert_allclose(found.sensitivity, slopes / slopes.sum(1, keepdims=True), atol=2e-3)
