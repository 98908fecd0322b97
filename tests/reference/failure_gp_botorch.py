"""Record BoTorch's posterior, marginal likelihood and gradients on a small data set.

Run in an environment that holds torch and botorch (they are in the `bench` extra):

    python tests/reference/failure_gp_botorch.py tests/golden/failure_gp.json
"""

import json
import sys

import botorch
import gpytorch
import numpy as np
import torch
from botorch.acquisition.analytic import LogExpectedImprovement
from botorch.models import SingleTaskGP
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from gpytorch.kernels import LinearKernel
from gpytorch.mlls import ExactMarginalLogLikelihood


def record(kernel: str, seed: int) -> dict:
    rng = np.random.default_rng(seed)
    n, d, m = 13, 4, 5
    x = rng.uniform(-0.5, 0.5, (n, d))
    y = np.sin(4 * x[:, 0]) + x[:, 1] * x[:, 2] + 0.1 * rng.normal(size=n)
    y = (y - y.mean()) / y.std(ddof=1)
    x_new = rng.uniform(-0.5, 0.5, (m, d))
    lengthscale = rng.uniform(0.4, 2.0, d)
    noise, mean = 0.03, 0.2
    tx, ty = torch.tensor(x), torch.tensor(y)[:, None]
    if kernel == "linear":
        covariance = LinearKernel(ard_num_dims=d)
        covariance.variance = torch.tensor(lengthscale**-2)[None]
    else:
        covariance = get_covar_module_with_dim_scaled_prior(
            ard_num_dims=d, use_rbf_kernel=kernel == "rbf"
        )
        covariance.lengthscale = torch.tensor(lengthscale)[None]
    model = SingleTaskGP(tx, ty, covar_module=covariance, outcome_transform=None)
    model.likelihood.noise = noise
    model.mean_module.initialize(constant=mean)
    model.train()
    output = model(tx)
    evidence = model.likelihood(output).log_prob(ty[:, 0])
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    objective = mll(model(tx), ty[:, 0])
    objective.backward()
    if kernel == "linear":
        raw = covariance.raw_variance
        slope = torch.autograd.functional.jacobian(
            covariance.raw_variance_constraint.transform, raw.detach()
        )
        slope = torch.diagonal(slope.reshape(d, d))
        by_length = (raw.grad.reshape(-1) / slope).numpy() * (-2.0 * lengthscale**-2)
    else:
        # botorch keeps these parameters untransformed
        by_length = covariance.raw_lengthscale.grad.reshape(-1).numpy() * lengthscale
    by_noise = float(model.likelihood.noise_covar.raw_noise.grad)
    model.eval()
    with torch.no_grad():
        posterior = model.posterior(torch.tensor(x_new))
        best = float(y.max())
        log_ei = LogExpectedImprovement(model, best_f=best)(torch.tensor(x_new)[:, None, :])
    return {
        "kernel": kernel,
        "x": x.tolist(),
        "y": y.tolist(),
        "x_new": x_new.tolist(),
        "lengthscale": lengthscale.tolist(),
        "noise": noise,
        "mean": mean,
        "log_marginal_likelihood": float(evidence),
        "map_objective": float(objective),
        "grad_log_lengthscale": by_length.tolist(),
        "grad_noise": by_noise,
        "posterior_mean": posterior.mean[:, 0].tolist(),
        "posterior_variance": posterior.variance[:, 0].tolist(),
        "log_ei": log_ei.tolist(),
    }


def main(path: str) -> None:
    torch.set_default_dtype(torch.float64)
    cases = [record(kernel, seed) for seed, kernel in enumerate(("matern52", "rbf", "linear"))]
    versions = {"botorch": botorch.__version__, "gpytorch": gpytorch.__version__}
    with open(path, "w", encoding="utf-8") as file:
        json.dump({"versions": versions, "cases": cases}, file, indent=1)
        file.write("\n")


if __name__ == "__main__":
    main(sys.argv[1])
