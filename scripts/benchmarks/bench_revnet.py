"""Memory of the reversible network's gradient against its depth.

    python scripts/benchmarks/bench_revnet.py

Prints the temporary memory of the compiled gradient (2048 samples of 60 parameters, float32) at
depths 8 and 64, with the reverse rule that recomputes activations and with JAX's own, which stores
them; the error of the inverse at trained weights, and at weights up to 64 times as large beside its
bound (`revnet.inverse_error_bound`). Expect a ratio of at most 1.1 for ours and of about 7 for the
other. Writes `results/bench_revnet.json`; 10 s on one core.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import provenance, repository, run_command, write_json


@dataclass(frozen=True)
class Config:
    """Sizes of the benchmark."""

    dim: int = 60
    samples: int = 2048
    depths: tuple[int, int] = (8, 64)
    out: Path = repository.RESULTS / "bench_revnet.json"


def peak(forward: Any, config: Config, depth: int) -> int:
    """Temporary memory of the compiled gradient [bytes]."""
    import jax
    import jax.numpy as jnp

    from failure import revnet

    params = jax.eval_shape(lambda: revnet.init(jax.random.key(0), config.dim, depth=depth))
    x = jax.ShapeDtypeStruct((config.samples, config.dim), jnp.float32)
    grad = jax.jit(jax.grad(lambda p, x: jnp.sum(forward(p, x) ** 2)))
    analysis: Any = grad.lower(params, x).compile().memory_analysis()
    return int(analysis.temp_size_in_bytes)


def extreme_weights(dim: int, dtype: str, scale: float) -> dict[str, float]:
    """Error of x -> z -> x at random weights of a given size, its bound, the largest feature."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure import revnet

    with jax.enable_x64(dtype == "float64"):
        params = revnet.init(jax.random.key(0), dim, depth=6, scale=scale, dtype=jnp.dtype(dtype))
        x = 3.0 * jax.random.normal(jax.random.key(1), (64, dim), jnp.dtype(dtype))
        z = jax.jit(revnet.forward_stored)(params, x)
        back = np.asarray(jax.jit(revnet.inverse)(params, z) - x, np.float64)
        return {
            "error": float(np.linalg.norm(back, axis=1).max()),
            "bound": float(revnet.inverse_error_bound(params, x).max()),
            "largest_feature": float(jnp.max(jnp.abs(z))),
        }


def inverse_error(dim: int, dtype: str) -> float:
    """Largest error of x -> z -> x after training on a nonlinear target, depth 8."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure import revnet

    with jax.enable_x64(dtype == "float64"):
        rng = np.random.default_rng(0)
        x = jnp.asarray(rng.normal(size=(256, dim)), dtype)
        y = jnp.sin(x[:, 0]) + x[:, 1] * x[:, 2]
        params = revnet.init(jax.random.key(0), dim, depth=8, dtype=jnp.dtype(dtype))

        def loss(p: Any) -> Any:
            return jnp.mean((revnet.forward(p, x)[:, 0] - y) ** 2)

        @jax.jit
        def train(p: Any) -> Any:
            def step(p: Any, _: None) -> tuple[Any, Any]:
                value, grad = jax.value_and_grad(loss)(p)
                grad = grad._replace(step=jnp.zeros_like(grad.step))
                return jax.tree.map(lambda a, g: a - 0.1 * g, p, grad), value

            return jax.lax.scan(step, p, None, length=300)

        params, _ = train(params)
        back = revnet.inverse(params, revnet.forward(params, x))
        return float(jnp.max(jnp.abs(back - x)))


def main(config: Config) -> dict[str, Any]:
    """Measure; returns what is also written."""
    from failure import revnet

    shallow, deep = config.depths
    result: dict[str, Any] = {"dim": config.dim, "samples": config.samples}
    for name, forward in (("recomputed", revnet.forward), ("stored", revnet.forward_stored)):
        few, many = (peak(forward, config, depth) for depth in (shallow, deep))
        result[name] = {f"bytes_depth_{shallow}": few, f"bytes_depth_{deep}": many}
        result[name]["ratio"] = many / few
    result["inverse_error"] = {t: inverse_error(config.dim, t) for t in ("float32", "float64")}
    result["extreme_weights"] = {
        t: {f"scale_{s:g}": extreme_weights(config.dim, t, s) for s in (0.5, 1.0, 4.0, 32.0)}
        for t in ("float32", "float64")
    }
    write_json(config.out, {"benchmark": "revnet", **provenance(), **result})
    return result


def fields(found: dict[str, Any]) -> dict[str, float]:
    """What the result line says."""
    return {
        "ratio": found["recomputed"]["ratio"],
        "ratio_stored": found["stored"]["ratio"],
        "inverse_float32": found["inverse_error"]["float32"],
        "inverse_float64": found["inverse_error"]["float64"],
        "extreme_float32": found["extreme_weights"]["float32"]["scale_32"]["error"],
    }


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
