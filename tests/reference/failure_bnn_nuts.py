"""Record predictions of a small Bayesian network sampled by NUTS, the oracle of the mean-field fit.

Run in an environment that holds numpyro:

    python tests/reference/failure_bnn_nuts.py tests/golden/failure_bnn.json
"""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS

HIDDEN = 8


def make_data(seed: int = 0, n: int = 80):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    y = np.stack([np.sin(1.5 * x[:, 0]) + 0.3 * x[:, 1], x[:, 1] * x[:, 2]], 1)
    return x, y + 0.2 * rng.normal(size=y.shape)


def network(x, y=None):
    n_in, n_out = x.shape[1], 2
    w1 = numpyro.sample("w1", dist.Normal(0, n_in**-0.5).expand([n_in, HIDDEN]).to_event(2))
    b1 = numpyro.sample("b1", dist.Normal(0, 1).expand([HIDDEN]).to_event(1))
    w2 = numpyro.sample("w2", dist.Normal(0, HIDDEN**-0.5).expand([HIDDEN, n_out]).to_event(2))
    b2 = numpyro.sample("b2", dist.Normal(0, 1).expand([n_out]).to_event(1))
    noise = numpyro.sample("noise", dist.LogNormal(-1, 1).expand([n_out]).to_event(1))
    mean = numpyro.deterministic("mean", jnp.tanh(x @ w1 + b1) @ w2 + b2)
    numpyro.sample("y", dist.Normal(mean, noise).to_event(2), obs=y)


def main(path: str) -> None:
    x, y = make_data()
    x_new, _ = make_data(1, 40)
    shift, scale = x.mean(0), x.std(0)
    y_shift, y_scale = y.mean(0), y.std(0)
    mcmc = MCMC(
        NUTS(network, max_tree_depth=7), num_warmup=300, num_samples=300, progress_bar=False
    )
    mcmc.run(jax.random.key(0), (x - shift) / scale, (y - y_shift) / y_scale)
    s = mcmc.get_samples()
    scaled = (x_new - shift) / scale
    hidden = jnp.tanh(jnp.einsum("ni,sih->snh", scaled, s["w1"]) + s["b1"][:, None])
    draws = jnp.einsum("snh,sho->sno", hidden, s["w2"]) + s["b2"][:, None]
    draws = np.asarray(draws) * y_scale + y_shift
    record = {
        "numpyro": numpyro.__version__,
        "hidden": HIDDEN,
        "x": x.tolist(),
        "y": y.tolist(),
        "x_new": x_new.tolist(),
        "mean": draws.mean(0).tolist(),
        "sd": draws.std(0).tolist(),
        "noise": (np.asarray(s["noise"]).mean(0) * y_scale).tolist(),
    }
    with open(path, "w", encoding="utf-8") as file:
        json.dump(record, file, indent=1)
        file.write("\n")


if __name__ == "__main__":
    main(sys.argv[1])
