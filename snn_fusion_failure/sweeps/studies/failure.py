r"""Study `failure`: search a circuit for its worst case, the whole search in one compiled program.

A Gaussian process in the full space, refitted every `refit_every` simulations; the next point is
the candidate with the best :math:`(1 - w) \mu + w \sigma`, candidates being drawn as TuRBO draws
them. Lighter than `failure.search.bayesopt`, which loops on the host and climbs to the maximum of
the acquisition: this one can be mapped over settings. Axes: `size`, half width of the box [sigma];
`weight`, :math:`w`; `region`, side of the box around the best point from which local candidates
come, as a share of the whole.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from failure import circuits
from failure.models import acquisition, gp, gp_fit
from failure.models.candidates import raw_points
from failure.models.domains import Domain, box, sample
from snn_fusion_failure.sweeps.study import Carry, Metric, Study


class SearchParams(NamedTuple):
    """Leaves of the search."""

    size: float = 3.0
    weight: float = 0.5
    region: float = 1.0


def make(
    circuit: str = "ldo",
    spec: str = "undershoot",
    n_init: int = 20,
    n_total: int = 60,
    refit_every: int = 10,
    candidates: int = 512,
    threshold: float | None = None,
) -> Study:
    """A circuit's specification; with a `threshold`, in the specification's unit, hits count."""
    if not 4 <= n_init < n_total or refit_every < 1 or candidates < 8:
        raise ValueError(
            f"{n_init=}, {n_total=}, {refit_every=}, {candidates=}: expected 4 <= n_init < "
            "n_total, refit_every >= 1 and candidates >= 8"
        )
    chosen = circuits.get(circuit)
    column, dim = chosen.spec_index(spec), chosen.n_dims
    unit, sense = chosen.specs[column].unit, chosen.specs[column].sense
    sign = 1.0 if sense == "max" else -1.0
    config = gp.GPConfig()

    def simulate(x: Any) -> Any:
        specs, status = chosen.run(x)
        return jnp.where(status == 0, sign * specs[:, column], jnp.nan)

    def filled(y: Any, n: Any) -> Any:
        """Outputs for the surrogate: an invalid one counts as the best case seen."""
        seen = (jnp.arange(n_total, dtype=n.dtype) < n) & jnp.isfinite(y)
        return jnp.where(seen, y, jnp.min(jnp.where(seen, y, jnp.inf)))

    def trial(params: SearchParams, key: Any, carry: Any, begin: int, end: int) -> Any:
        """Simulations up to `end`, from the start or from the carry of those before `begin`."""
        half = jnp.full((dim,), 0.5)
        cube = box(-half, half)
        scale = 2.0 * params.size
        u = jnp.zeros((n_total, dim)).at[:n_init].set(sample(cube, n_init, key=key))
        y = jnp.full((n_total,), jnp.nan).at[:n_init].set(simulate(scale * u[:n_init]))

        def step(carry: Any) -> Any:
            n, u, y, fitted = carry
            used = (jnp.arange(n_total, dtype=n.dtype) < n).astype(u.dtype)
            raw = filled(y, n)
            z, _, _ = gp.standardize(raw, used)
            due = (n - n_init) % refit_every == 0
            fitted = jax.lax.cond(
                due, lambda: gp_fit.fit(config, fitted, u, z, n, max_evals=60).params,
                lambda: fitted,
            )  # fmt: skip
            posterior = gp.condition(config, fitted, u, z, n)
            _, top = jax.lax.top_k(jnp.where(used > 0, raw, -jnp.inf), 4)
            reach = 0.5 * params.region
            local = Domain(
                jnp.maximum(-half, u[top[0]] - reach), jnp.minimum(half, u[top[0]] + reach),
                jnp.asarray(jnp.inf),
            )  # fmt: skip
            points = raw_points(local, u[top], candidates, key=jax.random.fold_in(key, n))
            mean, variance = gp.predict(config, posterior, points)
            value = acquisition.weighted(mean, jnp.sqrt(variance), jnp.asarray(params.weight))
            point = points[jnp.argmax(value)]
            y = y.at[n].set(simulate(scale * point[None])[0])
            return n + 1, u.at[n].set(point), y, fitted

        start = (u, y, gp_fit.initial_params(config, dim)) if carry is None else carry
        # Hidden from the compiler: a loop whose length it knows may be compiled differently, and a
        # search in parts would not be the search in one go.
        bounds = jnp.asarray([max(begin, n_init), max(end, n_init)], jnp.int32)
        bounds = jax.lax.optimization_barrier(bounds)
        _, *rest = jax.lax.while_loop(lambda c: c[0] < bounds[1], step, (bounds[0], *start))
        carry = tuple(rest)
        y = carry[1]
        done = jnp.arange(n_total) < end
        valid = jnp.isfinite(y) & done
        worst = sign * jnp.max(jnp.where(valid, y, -jnp.inf))
        first = sign * jnp.max(jnp.where(valid, y, -jnp.inf)[:n_init])
        out = {
            "worst": worst,
            "worst_initial": first,
            "invalid": jnp.sum(done & ~valid).astype(y.dtype),
        }
        if threshold is not None:
            failed = valid & (y > sign * threshold)
            out["hit"] = jnp.where(jnp.any(failed), 100.0, 0.0)
            number = (jnp.argmax(failed) + 1).astype(y.dtype)
            out["first_hit"] = jnp.where(jnp.any(failed), number, jnp.nan)
        return carry, out

    # One after another whatever the chunk size: a batched factorisation is no faster on a CPU, and
    # a search amplifies its last bits.
    def run(params: Any, keys: Any) -> Any:
        return jax.lax.map(lambda xs: trial(xs[0], xs[1], None, 0, n_total)[1], (params, keys))

    def begin_all(params: Any, keys: Any) -> Any:
        return jax.lax.map(lambda xs: trial(xs[0], xs[1], None, 0, n_init)[0], (params, keys))

    def advance(params: Any, keys: Any, carry: Any, begin: int, end: int) -> Any:
        return jax.lax.map(lambda xs: trial(xs[0], xs[1], xs[2], begin, end), (params, keys, carry))

    def check(params: SearchParams) -> None:
        for name, low, high in (("size", 0.0, 6.0), ("weight", -1e-9, 1.0), ("region", 0.0, 1.0)):
            values = getattr(params, name)
            if ((values <= low) | (values > high)).any():
                worst = values[(values <= low) | (values > high)][0]
                raise ValueError(f"{name} = {worst:g}: expected ({max(low, 0.0):g}, {high:g}]")

    metrics = {
        "worst": Metric(unit, f"worst {spec} found", "max" if sense == "max" else "min"),
        "worst_initial": Metric(unit, f"worst {spec} of the initial design"),
        "invalid": Metric("", "simulations that did not converge"),
    }
    if threshold is not None:
        metrics["hit"] = Metric(
            "%", f"searches that found {spec} beyond {threshold:g} {unit}", "max"
        )
        metrics["first_hit"] = Metric("", "simulations up to the first failure", "min", True)
    return Study(
        name="failure",
        options={},
        params=SearchParams(),
        run=run,
        metrics=metrics,
        objective="hit" if threshold is not None else "worst",
        unit_of=lambda leaf: "sigma" if leaf == "size" else "",
        check=check,
        dtype="float64",
        budget_text="simulations",
        carry=Carry(begin_all, advance, n_total),
    )
