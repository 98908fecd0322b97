"""Cost of the constraints: a training step with projection against the same step without.

    python scripts/benchmarks/bench_lattice.py

About one minute on one CPU thread. Prints one line for each model with the CPU time of a step and
the ratio (median over repeats that alternate between the two), then `result:` with the ratios.
A ratio of 1.15 means that constraints cost 15 % of an unconstrained step. Pin it to a core for a
steady figure: `taskset -c 0 python scripts/benchmarks/bench_lattice.py`.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import enable_compilation_cache, print_result, provenance, write_json


@dataclasses.dataclass(frozen=True)
class Config:
    """What is timed."""

    steps: int = 200
    """Steps of Adam in one jitted scan."""
    repeats: int = 7
    """Timings of each; the median counts."""
    seed: int = 0
    out: Path | None = None
    """Folder for `result.json`; nothing is written without it."""


def _models() -> dict[str, tuple[Any, Any, Any, tuple[int, ...]]]:
    """Name -> init(key), apply(params, x), project(params), shape of a batch of inputs."""
    import jax
    import numpy as np

    from fusion.lattice import DeepLatticeConfig, LatticeConfig, deep_lattice, lattice_layer

    models: dict[str, tuple[Any, Any, Any, tuple[int, ...]]] = {}
    for batch in (128, 1024, 4096):
        lattice = LatticeConfig((5, 5, 3, 3), (1, 1, 0, 0), output_range=(0.0, 1.0))
        models[f"lattice_5x5x3x3_batch_{batch}"] = (
            lambda key, c=lattice: lattice_layer.init(key, c),
            lambda p, x, c=lattice: lattice_layer.apply(c, p, 4.0 * x),
            lambda p, c=lattice: lattice_layer.project(c, p),
            (batch, 4),
        )
    # The source's use: one network for each of nine sensors, falling in its own loss.
    k = 9
    deep = DeepLatticeConfig(k, (-1,) + (0,) * (k - 1))
    order = np.stack([np.r_[i, np.delete(np.arange(k), i)] for i in range(k)])
    each = jax.vmap(lambda p, x: deep_lattice.apply(deep, p, x), (0, -2), -1)
    for batch in (16, 128):
        models[f"deep_lattice_9_networks_batch_{batch}"] = (
            lambda key: jax.vmap(deep_lattice.init, (0, None))(jax.random.split(key, k), deep),
            lambda p, x: each(p, x[..., order]),
            lambda p: jax.vmap(deep_lattice.project, (None, 0))(deep, p),
            (batch, k),
        )
    return models


def _train(
    apply: Callable[[Any, Any], Any], project: Callable[[Any], Any] | None, shape: tuple[int, ...]
) -> Callable[[Any, Any], Any]:
    """A jitted scan of Adam steps on a smooth target with noise, new inputs in every step."""
    import jax
    import jax.numpy as jnp
    import optax

    from fusion.lattice import with_projection

    optimizer: optax.GradientTransformation = optax.adam(1e-2)
    if project is not None:
        optimizer = with_projection(optimizer, project)

    def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], jax.Array]:
        params, state = carry
        x = jax.random.uniform(key, shape)
        noise = 0.1 * jax.random.normal(key, shape[:1])

        def loss_fn(params: Any) -> jax.Array:
            y = apply(params, x)
            target = jnp.maximum(x[:, 0], x[:, 1]) + noise
            return jnp.mean(jnp.square(y - target.reshape((-1,) + (1,) * (y.ndim - 1))))

        loss, grads = jax.value_and_grad(loss_fn)(params)
        updates, state = optimizer.update(grads, state, params)
        return (optax.apply_updates(params, updates), state), loss

    @jax.jit
    def run(params: Any, keys: jax.Array) -> Any:
        return jax.lax.scan(step, (params, optimizer.init(params)), keys)

    return run


def main(config: Config) -> dict[str, float]:
    """Time all models; returns name -> ratio of CPU time, projected over free."""
    import jax

    enable_compilation_cache()
    key = jax.random.key(config.seed)
    keys = jax.random.split(key, config.steps)
    ratios: dict[str, float] = {}
    table = {}
    for name, (init, apply, project, shape) in _models().items():
        params = init(key)
        runs = {
            "free": _train(apply, None, shape),
            "projected": _train(apply, project, shape),
        }
        times: dict[str, list[float]] = {kind: [] for kind in runs}
        for run in runs.values():
            jax.block_until_ready(run(params, keys))
        for _ in range(config.repeats):
            for kind, run in runs.items():
                start = time.process_time()
                jax.block_until_ready(run(params, keys))
                times[kind].append((time.process_time() - start) / config.steps * 1e6)
        free, projected = (statistics.median(times[kind]) for kind in ("free", "projected"))
        ratios[name] = statistics.median(
            b / a for a, b in zip(times["free"], times["projected"], strict=True)
        )
        table[name] = {"free_us": free, "projected_us": projected, "ratio": ratios[name]}
        print(
            f"{name:36s} free {free:8.1f} us  projected {projected:8.1f} us  "
            f"ratio {ratios[name]:.3f}",
            flush=True,
        )
    if config.out is not None:
        write_json(config.out / "result.json", {"timings": table, **provenance()})
    return ratios


if __name__ == "__main__":
    import tyro

    print_result(**main(tyro.cli(Config, description=__doc__)))
