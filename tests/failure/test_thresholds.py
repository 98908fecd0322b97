import jax.numpy as jnp
import numpy as np
import pytest

from failure.search.task import Task
from failure.search.thresholds import reachable


def two_hills(x):
    """A low hill that most ascents end on, a high one in a corner; one start in ten fails."""
    low = 1.0 - jnp.sum((x - 1.0) ** 2, 1)
    high = 6.0 - 2.0 * jnp.sum((x + 2.0) ** 2, 1)
    specs = jnp.stack([x[:, 0], jnp.maximum(low, high)], 1)
    return specs, (x[:, 1] > 2.5).astype(jnp.int32)


def test_the_higher_of_two_hills_is_reached_and_the_threshold_lies_in_between():
    reach = reachable(two_hills, 1, Task("box", 3.0, 2), share=0.9)
    assert np.isclose(reach.nominal, -1.0) and np.isclose(reach.worst, 6.0, atol=0.01)
    np.testing.assert_allclose(reach.x, [-2.0, -2.0], atol=0.1)
    assert np.isclose(reach.threshold, -1.0 + 0.9 * (reach.worst + 1.0))
    assert reach.n_simulations == 16 * 60


def test_a_specification_whose_small_values_are_bad():
    reach = reachable(two_hills, 0, Task("ball", 2.0, 2), sense="min", share=0.5)
    assert np.isclose(reach.worst, -2.0, atol=0.01) and np.isclose(reach.threshold, -1.0, atol=0.01)


def test_a_specification_in_femtoamperes_is_pushed_as_far():
    def tiny(x):
        specs, status = two_hills(x)
        return 1e-15 * specs, status

    task = Task("box", 3.0, 2)
    np.testing.assert_allclose(
        reachable(tiny, 1, task).worst, 1e-15 * reachable(two_hills, 1, task).worst, rtol=1e-6
    )


def test_bad_share():
    with pytest.raises(ValueError, match=r"share=1\.5"):
        reachable(two_hills, 0, Task("box", 3.0, 2), share=1.5)
    with pytest.raises(ValueError, match="sense='mni'"):
        reachable(two_hills, 0, Task("box", 3.0, 2), sense="mni")
