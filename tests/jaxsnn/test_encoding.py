"""Intervals and rates of section 2.4.2, regions of Figure 2.4, Poisson statistics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn.encoding import (
    angle_region,
    check_rates,
    group_rates,
    poisson_spikes,
    rate_table,
)

SONAR = [0.0, 99.0, 99.9, 100.0, 199.0, 200.0, 300.0]
DISTANCE = [0.0, 199.0, 200.0, 399.0, 400.0, 600.0, 800.0]
ANGLE = [0.0, 45.0, -45.0, 46.0, -46.0, 135.0, -135.0, 136.0, -136.0, 180.0]


@pytest.mark.parametrize(
    ("scheme", "sonar", "distance"),
    [
        ("reference", [0, 20, 40], [10, 20, 30, 40]),
        ("proposed", [0, 50, 100], [25, 50, 75, 100]),
    ],
)
def test_rates_are_those_of_the_text(scheme, sonar, distance):
    table = rate_table(scheme)

    def one(s, d, a):
        return group_rates(table, jnp.full(5, s), jnp.asarray(d), jnp.asarray(a))

    got = [float(one(s, 0.0, 0.0)[2]) for s in SONAR]
    assert got == [sonar[k] for k in (0, 0, 0, 1, 1, 2, 2)]
    got = [float(one(0.0, d, 0.0)[5]) for d in DISTANCE]
    assert got == [distance[k] for k in (0, 0, 1, 1, 2, 3, 3)]
    got = [float(one(0.0, 0.0, a)[6]) for a in ANGLE]
    # ahead, right, behind, left get the 1st to 4th rate
    assert got == [distance[k] for k in (0, 0, 0, 3, 1, 3, 1, 2, 2, 2)]


def test_each_sonar_drives_its_own_group():
    rates = group_rates(
        rate_table("proposed"), jnp.array([0.0, 150.0, 250.0, 50.0, 100.0]),
        jnp.asarray(450.0), jnp.asarray(-90.0),
    )  # fmt: skip
    assert rates.tolist() == [0.0, 50.0, 100.0, 0.0, 50.0, 75.0, 50.0]


def test_regions_are_quarters_and_mirror():
    angle = jnp.arange(-179.5, 180.0)
    region = np.asarray(angle_region(angle))
    assert np.bincount(region).tolist() == [90, 90, 90, 90]
    mirrored = np.asarray(angle_region(-angle))
    np.testing.assert_array_equal(mirrored, np.array([0, 3, 2, 1])[region])


@pytest.mark.parametrize(
    ("code", "order"), [("region", (0, 1, 2, 3)), ("listed", (0, 3, 1, 2)), ("ring", (1, 0, 3, 2))]
)
def test_angle_codes_permute_the_same_rates(code, order):
    assert rate_table("proposed", code).angle.tolist() == [25.0 * (k + 1) for k in order]


def test_poisson_rate_variance_and_independence():
    rates = jnp.array([0.0, 25.0, 100.0, 400.0, 1000.0])
    spikes = np.asarray(poisson_spikes(rates, 40000, key=jax.random.key(0), dt=1e-3))
    assert set(np.unique(spikes)) <= {0.0, 1.0}
    p = np.asarray(rates) * 1e-3
    sd = np.sqrt(p * (1 - p) / len(spikes))
    assert (np.abs(spikes.mean(0) - p) <= 5 * sd + 2**-16).all()
    cross = np.corrcoef(spikes[:, 1:4].T)
    assert np.abs(cross - np.eye(3)).max() < 0.03
    x = spikes[:, 3] - p[3]
    assert abs((x[1:] * x[:-1]).mean()) < 5 * p[3] * (1 - p[3]) / np.sqrt(len(x))


def test_spikes_depend_on_the_key_only():
    rates = jnp.full(7, 200.0)
    a, b, c = (poisson_spikes(rates, 50, key=jax.random.key(k), dt=1e-3) for k in (1, 1, 2))
    assert (a == b).all() and (a != c).any()


@pytest.mark.parametrize(
    ("call", "part"),
    [
        (lambda: check_rates(jnp.array([jnp.nan]), dt=1e-3), "rates=nan"),
        (lambda: check_rates(jnp.array([-1.0]), dt=1e-3), "rates=-1"),
        (lambda: check_rates(jnp.array([2000.0]), dt=1e-3), "at most one spike per step"),
    ],
)
def test_bad_rates_are_named(call, part):
    with pytest.raises(ValueError, match=part):
        call()
