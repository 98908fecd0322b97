"""The numeric functions of `failure` under jit, vmap, scan and grad: one table, in float64."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import bnn, revnet
from failure.circuits.buck import cycle
from failure.circuits.solver import mosfet
from failure.models import acquisition, domains, gp, gp_fit
from failure.models.kernels import KERNELS
from failure.search import spaces, turbo
from failure.search.task import task_domain
from tests._api import Case, check

N, D = 6, 2
GP = gp.GPConfig()
BNN, BNN_TRAIN = bnn.BNNConfig(hidden=3), bnn.BNNTrainParams()
TASK = spaces.Task("box", 3.0, 4)
LDO_LIKE = {"polarity": 1.0, "mobility": 0.05, "early": 4e6, "overlap": 3e-10}


def key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))


def normal(*shapes: tuple[int, ...]) -> Any:
    """Arguments drawn from a normal distribution."""
    return lambda rng: tuple(rng.normal(size=shape) for shape in shapes)


def net(rng: np.random.Generator) -> revnet.RevNetParams:
    return _revnet(key(rng))


_revnet = jax.jit(lambda k: revnet.init(k, 4, depth=2, width=3, dtype=jnp.float64))


def gp_params(rng: np.random.Generator) -> gp.GPParams:
    return gp.GPParams(0.3 * rng.normal(size=D), np.float64(-3.0), np.float64(0.1))


def data(rng: np.random.Generator) -> tuple:
    return gp_params(rng), rng.normal(size=(N, D)), rng.normal(size=N)


def transistor(rng: np.random.Generator) -> tuple:
    return rng.uniform(0.2, 1.5, 4), rng.uniform(0.05, 1.5, 4), rng.uniform(1e-6, 1e-5, 4)


def devices(width: jax.Array) -> mosfet.MosParams:
    full = {k: jnp.full_like(width, v) for k, v in LDO_LIKE.items()}
    rest = {"length": 1e-6, "vto": 0.45, "tox": 4e-9}
    return mosfet.mos_params(
        **full, width=width, **{k: jnp.full_like(width, v) for k, v in rest.items()}
    )


def posterior(params: gp.GPParams, x: jax.Array, y: jax.Array) -> gp.Posterior:
    return gp.condition(GP, params, x, y, jnp.asarray(N, jnp.int32))


CASES = [
    Case("revnet.forward", revnet.forward, lambda rng: (net(rng), rng.normal(size=(3, 4))), (0, 1)),
    Case(
        "revnet.forward_stored",
        revnet.forward_stored,
        lambda rng: (net(rng), rng.normal(size=4)),
        (0, 1),
    ),
    Case("revnet.inverse", revnet.inverse, lambda rng: (net(rng), rng.normal(size=4)), (0, 1)),
    Case("acquisition.log_h", acquisition.log_h, lambda rng: (rng.uniform(-30, 5, 6),)),
    Case(
        "acquisition.log_ei",
        acquisition.log_ei,
        lambda rng: (rng.normal(size=4), rng.uniform(0.1, 2, 4), np.float64(1.0)),
        (0, 1, 2),
    ),
    Case(
        "acquisition.confidence_bound",
        lambda m, s: acquisition.confidence_bound(m, s, 2.0),
        lambda rng: (rng.normal(size=4), rng.uniform(0.1, 2, 4)),
        (0, 1),
    ),
    Case(
        "acquisition.weighted",
        acquisition.weighted,
        lambda rng: (rng.normal(size=4), rng.uniform(0.1, 2, 4), rng.random(4)),
        (0, 1, 2),
    ),
    Case(
        "acquisition.acquisition_value",
        lambda m, s, b, w: acquisition.acquisition_value(
            acquisition.AcquisitionConfig(), m, s, b, w
        ),
        lambda rng: (rng.normal(size=4), rng.uniform(0.1, 2, 4), np.float64(1.0), rng.random(4)),
        (0, 1, 2),
    ),
    Case(
        "gp.standardize",
        gp.standardize,
        lambda rng: (rng.normal(size=N), np.array([1.0] * 4 + [0.0] * 2)),
    ),
    *(
        Case(
            f"kernels.kernel_matrix ({kernel})",
            lambda p, a, b, kernel=kernel: gp.kernel_matrix(gp.GPConfig(kernel=kernel), p, a, b),
            lambda rng: (*data(rng)[:2], rng.normal(size=(3, D))),
            (0, 1, 2),
        )
        for kernel in KERNELS
    ),
    Case("gp.condition", lambda p, x, y: posterior(p, x, y).alpha, data, (0, 1, 2)),
    Case(
        "gp.predict",
        lambda p, x, y, new: gp.predict(GP, posterior(p, x, y), new),
        lambda rng: (*data(rng), rng.normal(size=(3, D))),
        (0, 1, 2, 3),
    ),
    Case(
        "gp_fit.log_marginal_likelihood",
        lambda p, x, y: gp_fit.log_marginal_likelihood(GP, p, x, y, jnp.asarray(N, jnp.int32)),
        data,
        (0, 1, 2),
    ),
    Case("gp_fit.log_prior", lambda p: gp_fit.log_prior(GP, p), lambda rng: (gp_params(rng),)),
    Case(
        "domains.project",
        lambda x: domains.project(domains.ball(3, 1.0), x) ** 2,
        normal((3,)),
    ),
    Case(
        "domains.sample",
        lambda k: domains.sample(domains.box(-jnp.ones(3), jnp.ones(3)), 4, key=k),
        lambda rng: (key(rng),),
        (),
        "a draw",
    ),
    Case(
        "spaces.random_embedding (decode)",
        lambda u: spaces.random_embedding(TASK, 2, key=jax.random.key(0)).decode(
            task_domain(TASK), u
        ),
        lambda rng: (rng.uniform(-0.4, 0.4, 2),),
    ),
    Case(
        "spaces.initial_design (encode)",
        lambda scale, x: spaces.FullSpace(scale).encode(x),
        lambda rng: (np.float64(3.5), rng.normal(size=4)),
        (0, 1),
    ),
    Case(
        "spaces.initial_design",
        lambda k: spaces.initial_design(spaces.FullSpace(jnp.asarray(6.0)), TASK, 3, key=k),
        lambda rng: (key(rng),),
        (),
        "a draw",
    ),
    Case(
        "turbo.trust_region",
        lambda centre, length, scales: turbo.trust_region(
            domains.box(-jnp.ones(D), jnp.ones(D)), centre, length, scales
        )[:2],
        lambda rng: (rng.uniform(-0.2, 0.2, D), np.float64(0.4), 0.1 * rng.normal(size=D)),
        (0, 1, 2),
    ),
    Case(
        "circuits.mosfet.level1",
        lambda vgs, vds, w: mosfet.level1(devices(w), vgs, vds)[0],
        transistor,
        (0, 1, 2),
    ),
    Case(
        "circuits.mosfet.ekv",
        lambda vgs, vds, w: mosfet.ekv(devices(w), vgs, vds)[0],
        transistor,
        (0, 1, 2),
    ),
    Case(
        "circuits.mosfet.drain_current",
        lambda vg, vd, w: mosfet.drain_current("ekv", devices(w), vd, vg, jnp.zeros_like(vg)),
        transistor,
        (0, 1, 2),
    ),
    Case("circuits.mosfet.mos_params", devices, lambda rng: transistor(rng)[2:]),
    Case("circuits.cycle.expm", cycle.expm, lambda rng: (0.3 * rng.normal(size=(3, 3, 2)),)),
    Case(
        "bnn.negative_elbo",
        lambda k, x, y: bnn.negative_elbo(
            BNN, BNN_TRAIN, bnn.init(k, BNN, BNN_TRAIN, x, y), x, y, key=k
        ),
        lambda rng: (key(rng), rng.normal(size=(6, 2)), rng.normal(size=(6, 3))),
        (2,),
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_jit_once_vmap_is_scan_and_slopes_are_finite(case: Case) -> None:
    check(case, x64=True, rtol=1e-8, atol=1e-10)
