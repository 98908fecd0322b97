"""STDP: pairs against the curve, the eligibility trace, the two rules and their bounds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsnn import plasticity
from jaxsnn.plasticity import STDPParams, apply_reward, check_bounds, check_stdp

DT = 1e-3
PARAMS = STDPParams(a_plus=1.0, a_minus=-0.7, tau_plus=15e-3, tau_minus=30e-3, tau_z=40e-3)


@pytest.fixture(scope="module")
def run():
    @jax.jit
    def scan(params, pre, post):
        def body(state, spikes):
            state = plasticity.stdp_step(params, state, *spikes, dt=DT)
            return state, state.z

        state = plasticity.stdp_init(pre.shape[1], post.shape[1])
        return jax.lax.scan(body, state, (pre, post))

    return scan


@pytest.mark.parametrize("lag", [-20, -5, 5, 20])
def test_one_pair_integrates_to_the_stdp_curve(run, lag):
    """The time integral of z after one pair is Eq. 2.2, whatever tau_z is."""
    pre, post = np.zeros((600, 1), np.float32), np.zeros((600, 1), np.float32)
    pre[50], post[50 + lag] = 1.0, 1.0
    for tau_z in (10e-3, 40e-3):
        params = PARAMS._replace(tau_z=tau_z)
        _, z = run(params, pre, post)
        # The sum over steps exceeds the integral by the first half step of the exponential.
        total = float(z.sum()) * DT * (1 - np.exp(-DT / tau_z)) / (DT / tau_z)
        want = plasticity.stdp_curve(params, jnp.array([lag * DT]))[0]
        np.testing.assert_allclose(total, want, rtol=1e-4)


def test_coincident_spikes_count_both_ways(run):
    one = np.zeros((3, 1), np.float32)
    one[0] = 1.0
    _, z = run(PARAMS, one, one)
    np.testing.assert_allclose(z[0, 0, 0], (1.0 - 0.7) / 40e-3, rtol=1e-5)


def test_anti_causal_factor_scales_one_half(run):
    rng = np.random.default_rng(0)
    pre, post = (rng.random((200, 3)) < 0.1).astype(np.float32), np.zeros((200, 2), np.float32)
    post[::7] = 1.0
    full = run(PARAMS, pre, post)[1]
    none = run(PARAMS._replace(anti_causal=0.0), pre, post)[1]
    half = run(PARAMS._replace(anti_causal=0.5), pre, post)[1]
    np.testing.assert_allclose(half, (full + none) / 2, atol=1e-4)
    assert (none >= 0).all() and (full < 0).any()


def test_trace_matches_a_sum_over_pairs(run):
    """Numpy oracle in float64: every pair of spikes, one at a time."""
    rng = np.random.default_rng(1)
    pre = (rng.random((80, 3)) < 0.15).astype(np.float32)
    post = (rng.random((80, 2)) < 0.15).astype(np.float32)
    state, _ = run(PARAMS, pre, post)
    p, end = PARAMS, 79
    z = np.zeros((3, 2))
    for j in range(3):
        for i in range(2):
            for s in np.flatnonzero(pre[:, j]):
                for t in np.flatnonzero(post[:, i]):
                    later = max(s, t)
                    xi = 0.0
                    if s <= t:
                        xi += p.a_plus * np.exp(-(t - s) * DT / p.tau_plus)
                    if t <= s:
                        xi += p.a_minus * np.exp(-(s - t) * DT / p.tau_minus)
                    z[j, i] += xi / p.tau_z * np.exp(-(end - later) * DT / p.tau_z)
    np.testing.assert_allclose(state.z, z, rtol=2e-5, atol=1e-4)


def test_curves_have_the_shape_of_the_figures():
    dt = jnp.arange(-100.0, 101.0) * 1e-3
    curve = plasticity.stdp_curve(STDPParams(), dt)
    assert (curve[101:] > 0).all() and (curve[:100] < 0).all() and curve[100] == 0
    assert (jnp.diff(curve[101:]) < 0).all() and (jnp.diff(curve[:100]) < 0).all()
    surface = plasticity.rm_stdp_curve(STDPParams(), dt, jnp.array([-1.0, 0.0, 2.0]))
    np.testing.assert_allclose(surface[0], -curve, rtol=1e-6)
    np.testing.assert_allclose(surface[2], 2 * curve)


weights = st.lists(st.floats(0, 5, width=32), min_size=1, max_size=8)
drives = st.floats(-100, 100, width=32)


@settings(max_examples=25, deadline=None)
@given(
    w=weights,
    d=drives,
    rule=st.sampled_from(["additive", "multiplicative"]),
    bounds=st.sampled_from(["hard", "soft"]),
)
def test_rules_keep_bounds_order_and_sign(w, d, rule, bounds):
    w = jnp.sort(jnp.asarray(w, jnp.float32))
    new = apply_reward(w, jnp.full(w.shape, d, jnp.float32), 0.0, 5.0, rule=rule, bounds=bounds)
    assert bool(jnp.all((new >= 0) & (new <= 5)))
    assert bool(jnp.all(jnp.diff(new) >= -1e-5))  # a common drive never swaps two weights
    moved = (new - w) * np.sign(d)
    assert bool(jnp.all(moved >= -1e-5))


def test_zero_reward_changes_nothing():
    w = jnp.linspace(0.0, 5.0, 11)
    for rule in ("additive", "multiplicative"):
        for bounds in ("hard", "soft"):
            new = apply_reward(w, jnp.zeros(11), 0.0, 5.0, rule=rule, bounds=bounds)
            np.testing.assert_allclose(new, w, atol=1e-6)


@pytest.mark.parametrize(
    ("rule", "bounds", "slope"),
    [
        ("additive", "hard", lambda w, u: u),
        ("multiplicative", "hard", lambda w, u: w * u),
        ("additive", "soft", lambda w, u: u * ((5.0 - w) / 5.0 if u > 0 else w / 5.0)),
        ("multiplicative", "soft", lambda w, u: w * (1 - w / 5.0) * u),
    ],
)
@pytest.mark.parametrize("drive", [0.8, -0.8])
def test_closed_forms_solve_the_rules(rule, bounds, slope, drive):
    """The update equals many small Euler steps of the differential equation."""
    w = 2.0
    for _ in range(20000):
        w += slope(w, drive / 20000)
    got = apply_reward(jnp.array([2.0]), jnp.array([drive]), 0.0, 5.0, rule=rule, bounds=bounds)
    np.testing.assert_allclose(got[0], w, rtol=1e-4)


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: check_stdp(STDPParams(tau_z=-1.0), dt=DT), ["tau_z", "-1.0"]),
        (lambda: check_stdp(STDPParams(a_plus=float("inf")), dt=DT), ["a_plus", "finite"]),
        (lambda: check_bounds(jnp.array([1.0, 7.0]), 0.0, 5.0), ["7", "[0, 5]", "clip"]),
        (lambda: check_bounds(jnp.array([jnp.nan]), 0.0, 5.0), ["weights=nan", "expected finite"]),
    ],
)
def test_bad_input_is_named(call, names):
    with pytest.raises(ValueError) as error:
        call()
    for part in names:
        assert part in str(error.value)
