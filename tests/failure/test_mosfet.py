from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failure.circuits.solver.mosfet import (
    NMOS,
    SLOPE,
    U_T,
    MosParams,
    drain_current,
    ekv,
    level1,
    mos_params,
)

VOLTS = st.floats(-2.5, 2.5)


def device(polarity: float = 1.0) -> MosParams:
    return mos_params(
        *(jnp.float64(v) for v in (polarity, NMOS.mobility, NMOS.early, NMOS.overlap)),
        width=jnp.float64(10e-6),
        length=jnp.float64(0.5e-6),
        vto=jnp.float64(0.45),
        tox=jnp.float64(7.5e-9),
    )


def test_parameters_of_the_nominal_device() -> None:
    with jax.enable_x64(True):
        p = device()
    assert float(p.beta) == pytest.approx(0.04 * 3.9 * 8.8541878128e-12 / 7.5e-9 * 20.0)
    assert float(p.lam) == pytest.approx(0.08)
    assert float(p.cgd) == pytest.approx(3e-15)
    cox = 3.9 * 8.8541878128e-12 / 7.5e-9
    assert float(p.cgs) == pytest.approx(2 / 3 * 5e-12 * cox + 3e-15)


def test_level1_closed_form() -> None:
    with jax.enable_x64(True):
        p = device()
        saturation, gm, gds = level1(p, jnp.float64(1.0), jnp.float64(1.5))
        linear, _, _ = level1(p, jnp.float64(1.0), jnp.float64(0.2))
        off, _, _ = level1(p, jnp.float64(0.3), jnp.float64(1.0))
    beta = float(p.beta)
    assert float(saturation) == pytest.approx(beta / 2 * 0.55**2 * (1 + 0.08 * 1.5))
    assert float(gm) == pytest.approx(beta * 0.55 * (1 + 0.08 * 1.5))
    assert float(gds) == pytest.approx(beta / 2 * 0.55**2 * 0.08)
    assert float(linear) == pytest.approx(beta / 2 * (2 * 0.55 * 0.2 - 0.04) * (1 + 0.08 * 0.2))
    assert float(off) == 0.0


@pytest.mark.parametrize("model", ["ekv", "level1"])
@settings(max_examples=60, deadline=None)
@given(vd=VOLTS, vg=VOLTS, vs=VOLTS, polarity=st.sampled_from([1.0, -1.0]))
def test_conductances_are_the_derivatives(
    model: str, vd: float, vg: float, vs: float, polarity: float
) -> None:
    with jax.enable_x64(True):
        p = device(polarity)

        def current(d: jax.Array, g: jax.Array, s: jax.Array) -> jax.Array:
            return drain_current(model, p, d, g, s)[0]

        v = tuple(jnp.float64(x) for x in (vd, vg, vs))
        _, gm, gds = drain_current(model, p, *v)
        by_d, by_g, by_s = jax.grad(current, argnums=(0, 1, 2))(*v)
    close = {"rtol": 1e-7, "atol": 1e-12}
    if model == "level1" and abs(vd - vs) < 1e-9:
        return  # |v_ds| has a corner at zero
    if model == "ekv" and min(abs(polarity * (vg - v) - float(p.vto)) for v in (vd, vs)) < 1e-12:
        return  # automatic differentiation of max(u, 0) is one-sided at the threshold itself
    np.testing.assert_allclose(gm, by_g, **close)
    np.testing.assert_allclose(gds, by_d, **close)
    np.testing.assert_allclose(-(gm + gds), by_s, **close)


@pytest.mark.parametrize("model", ["ekv", "level1"])
@settings(max_examples=40, deadline=None)
@given(vd=VOLTS, vg=VOLTS, vs=VOLTS)
def test_source_and_drain_are_alike(model: str, vd: float, vg: float, vs: float) -> None:
    with jax.enable_x64(True):
        p = device()
        one = drain_current(model, p, *(jnp.float64(v) for v in (vd, vg, vs)))[0]
        other = drain_current(model, p, *(jnp.float64(v) for v in (vs, vg, vd)))[0]
    np.testing.assert_allclose(one, -other, rtol=1e-9, atol=1e-18)


def test_ekv_limits() -> None:
    """Square law far above threshold, an exponential far below."""
    with jax.enable_x64(True):
        p = device()._replace(lam=jnp.float64(0.0))
        v = jnp.float64(2.0)
        strong = ekv(p, v, v)[0] / level1(p, v, v)[0]
        low = jnp.array([0.05, 0.06])
        weak = ekv(jax.tree.map(lambda a: a[None], p), low, jnp.full(2, 1.0))[0]
    assert float(strong) == pytest.approx(1.0, abs=1e-3)
    slope = float(jnp.log(weak[1] / weak[0])) / 0.01
    assert slope == pytest.approx(1.0 / (SLOPE * U_T), rel=0.01)


def test_unknown_model_names_the_known() -> None:
    with (
        jax.enable_x64(True),
        pytest.raises(ValueError, match=r"model='bsim4': expected one of 'ekv', 'level1'"),
    ):
        drain_current("bsim4", device(), jnp.float64(1), jnp.float64(1), jnp.float64(0))
