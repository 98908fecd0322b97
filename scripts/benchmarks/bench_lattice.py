"""Speed of lattices: what constraints cost, and forward and backward against pytorch-lattice.

    python scripts/benchmarks/bench_lattice.py
    python scripts/benchmarks/bench_lattice.py --parts constraints first_init peer --record

Three parts, all times CPU times of one thread, medians over repeats that alternate between the two
sides. `constraints`: a training step with projection over the same step without; 1.15 means that
constraints cost 15 % of a step. `first_init`: the first parameters of a lattice that is monotone
in all inputs, with what has to be compiled. `peer`: the time of pytorch-lattice for forward and
backward (slopes of table and inputs) of a lattice of 2^6 to 2^12 vertices on a batch of 1,024, over
ours on the same numbers; it computes in float64, so ours is timed in both. This part needs
`pip install torch==2.13.0 pandas tqdm` and `pip install --no-deps pytorch-lattice==0.2.0` (it asks
for an older NumPy than ours and works with it), best in an environment of its own.

Two minutes. `--record` writes `results/bench_lattice.json`; pin the command to a core for steady
figures: `taskset -c 0 python scripts/benchmarks/bench_lattice.py`.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)
from snn_fusion_failure.runs.origin import check_recordable


@dataclasses.dataclass(frozen=True)
class Config:
    """What is timed."""

    parts: tuple[Literal["constraints", "first_init", "peer"], ...] = ("constraints",)
    """Which parts."""
    steps: int = 200
    """Steps of Adam in one jitted scan."""
    repeats: int = 7
    """Timings of each; the median counts."""
    ranks: tuple[int, ...] = (6, 8, 10, 12)
    """Lattices of the other parts: 2^rank vertices."""
    batch: int = 1024
    """Rows of the part `peer`."""
    calls: int = 20
    """Calls in each timing of the part `peer`."""
    seed: int = 0
    record: bool = False
    """Write `results/bench_lattice.json`."""


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


def _alternate(
    calls: Mapping[str, Callable[[], Any]], repeats: int, per: int
) -> dict[str, list[float]]:
    """CPU microseconds of each call over `per`, `repeats` times in turn, after a first one."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.process_time()
            call()
            times[name].append((time.process_time() - start) / per * 1e6)
    return times


def _repeat(call: Callable[[], Any], count: int) -> list[Any]:
    return [call() for _ in range(count)]


def _wait(run: Callable[..., Any], *arguments: Any) -> None:
    import jax

    jax.block_until_ready(run(*arguments))


def constraints(config: Config) -> dict[str, dict[str, float]]:
    """A step with projection over the step without, for each model."""
    import jax

    key = jax.random.key(config.seed)
    keys = jax.random.split(key, config.steps)
    table = {}
    for name, (init, apply, project, shape) in _models().items():
        params = init(key)
        calls = {
            kind: functools.partial(_wait, _train(apply, p, shape), params, keys)
            for kind, p in (("free", None), ("projected", project))
        }
        times = _alternate(calls, config.repeats, config.steps)
        pairs = zip(*times.values(), strict=True)
        row = {f"{kind}_us": statistics.median(found) for kind, found in times.items()}
        table[name] = row | {"ratio": statistics.median(b / a for a, b in pairs)}
        print(f"{name:36s} ratio {table[name]['ratio']:.3f}", flush=True)
    return table


def first_init(config: Config) -> dict[str, dict[str, float]]:
    """CPU seconds of the first parameters of lattices with all inputs monotone."""
    import jax

    from fusion.lattice import LatticeConfig, lattice_layer

    found: dict[str, dict[str, float]] = {}
    key = jax.block_until_ready(jax.random.key(config.seed))
    jax.config.update("jax_enable_compilation_cache", False)
    for rank in config.ranks:
        jax.clear_caches()
        start = time.process_time()
        jax.block_until_ready(lattice_layer.init(key, LatticeConfig((2,) * rank, (1,) * rank)))
        found[f"2^{rank}"] = {"seconds": time.process_time() - start}
    jax.config.update("jax_enable_compilation_cache", True)
    return found


def _ours(rank: int, dtype: str, table: Any, x: Any) -> dict[str, Callable[[], Any]]:
    """Forward, and forward with backward, of the lattice layer."""
    import jax
    import jax.numpy as jnp

    from fusion.lattice import LatticeConfig, lattice_layer
    from fusion.lattice.lattice_config import LatticeParams

    config = LatticeConfig((2,) * rank)
    params, inputs = LatticeParams(jnp.asarray(table, dtype)), jnp.asarray(x, dtype)
    forward = jax.jit(lambda p, x: lattice_layer.apply(config, p, x))
    backward = jax.jit(
        jax.value_and_grad(lambda p, x: jnp.sum(lattice_layer.apply(config, p, x)), (0, 1))
    )
    return {
        "forward": lambda: jax.block_until_ready(forward(params, inputs)),
        "backward": lambda: jax.block_until_ready(backward(params, inputs)),
    }


def _theirs(rank: int, table: Any, x: Any) -> dict[str, Callable[[], Any]]:
    """The same by pytorch-lattice, as it is installed: in float64."""
    import torch
    from pytorch_lattice.layers import Lattice

    torch.set_num_threads(1)
    layer = Lattice([2] * rank)
    layer.kernel = torch.nn.Parameter(torch.tensor(table).double().reshape(-1, 1))
    inputs = torch.tensor(x).double().requires_grad_()

    def forward() -> Any:
        with torch.no_grad():
            return layer(inputs)[:, 0].numpy()

    def backward() -> Any:
        total = layer(inputs).sum()
        return total, torch.autograd.grad(total, (layer.kernel, inputs))

    return {"forward": forward, "backward": backward}


def peer(config: Config) -> dict[str, dict[str, float]]:
    """pytorch-lattice's time over ours, for each size; outputs compared first."""
    import jax
    import numpy as np

    try:
        import pytorch_lattice  # noqa: F401
    except ImportError as error:
        raise ValueError(
            "parts=peer: expected torch and pytorch-lattice; install them as --help says"
        ) from error
    rng, found = np.random.default_rng(config.seed), {}
    for rank in config.ranks:
        table = rng.normal(size=(2,) * rank).astype(np.float32)
        x = rng.uniform(size=(config.batch, rank)).astype(np.float32)
        row: dict[str, float] = {"vertices": 2**rank}
        theirs = _theirs(rank, table, x)
        for dtype in ("float32", "float64"):
            with jax.enable_x64(dtype == "float64"):
                ours = _ours(rank, dtype, table, x)
                gap = float(np.max(np.abs(np.asarray(ours["forward"]()) - theirs["forward"]())))
                if gap > 1e-5:
                    raise ValueError(f"outputs={gap}: expected equal to 1e-5; report it")
                row[f"largest_difference_{dtype}"] = gap
                for kind in ("forward", "backward"):
                    calls = {
                        side: functools.partial(_repeat, part[kind], config.calls)
                        for side, part in (("ours", ours), ("theirs", theirs))
                    }
                    times = _alternate(calls, config.repeats, config.calls)
                    pairs = zip(times["ours"], times["theirs"], strict=True)
                    row[f"{kind}_us_{dtype}"] = statistics.median(times["ours"])
                    row[f"{kind}_us_pytorch_lattice"] = statistics.median(times["theirs"])
                    row[f"{kind}_ratio_{dtype}"] = statistics.median(b / a for a, b in pairs)
        found[f"2^{rank}"] = row
        shown = "  ".join(f"{k} {v:.1f}" for k, v in row.items() if "ratio" in k)
        print(f"2^{rank:<3d} {shown}", flush=True)
    return found


SHOWN = {
    "seconds": ("first parameters, all inputs monotone", "s"),
    "ratio": ("step with projection over step without", "1"),
    "forward_ratio_float32": ("pytorch-lattice over ours, forward", "1"),
    "backward_ratio_float32": ("pytorch-lattice over ours, forward and backward", "1"),
}
"""Figures of the parts that the page of results has, each a median."""


def table_rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The figures of `SHOWN` in the schema of record."""
    found = []
    for part in ("first_init", "peer", "constraints"):
        for row, given in result.get(part, {}).items():
            for name in SHOWN.keys() & given.keys():
                metric, unit = SHOWN[name]
                cell = {"row": row, "model": "float32", "metric": metric, "unit": unit}
                found.append(cell | summarize([given[name]]))
    return found


def main(config: Config) -> dict[str, Any]:
    """Run the parts; returns what is written."""
    enable_compilation_cache()
    result: dict[str, Any] = {"benchmark": "lattice", "batch": config.batch, **provenance()}
    for name, part in (("constraints", constraints), ("first_init", first_init), ("peer", peer)):
        if name in config.parts:
            result[name] = part(config)
    if "peer" in config.parts:
        from importlib.metadata import version

        peers = {name: version(name) for name in ("torch", "pytorch-lattice")}
        result["versions"] = {**result["versions"], **peers}
    title = "Lattices: constraints, first parameters, pytorch-lattice"
    result |= {"title": title, "rows": table_rows(result)}
    if config.record:
        check_recordable()
        write_json(repository.RESULTS / "bench_lattice.json", result)
    return result


def _fields(result: dict[str, Any]) -> dict[str, float]:
    """The smallest ratios beside pytorch-lattice."""
    rows = result.get("peer", {}).values()
    names = ("forward_ratio_float32", "backward_ratio_float32") if rows else ()
    return {f"smallest_{name}": min(row[name] for row in rows) for name in names}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=_fields)
