"""Speed, memory and accuracy of the network's two forms, as ratios from one run.

    taskset -c 0 python scripts/benchmarks/bench_snn.py
    taskset -c 0 python scripts/benchmarks/bench_snn.py --brian2-python PATH/TO/python --record

Unit: robot-milliseconds per CPU-second (one robot, 1 ms, all 44,308 synapses of S4 plastic), world
and learning included, robots in blocks. Also the per-step form, the share of the GEMM peak, the
memory per robot, and how far weights held for a window drift from weights that change every
millisecond. CPU time of the process, so a busy machine disturbs it little; pin it to one core.
About three CPU-minutes, half of it compiling.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)


@dataclasses.dataclass(frozen=True)
class Bench:
    """What to measure."""

    robots: tuple[int, ...] = (16, 64, 256)
    """Batch sizes of the window form."""
    window: int = 50
    """Steps per window and per control step."""
    block: int = 8
    """Robots per block."""
    control_steps: int = 64
    """Control steps per timed call at 64 robots; other batches do as much work, in 16 or more."""
    repeats: int = 3
    """Timed calls; the median counts."""
    accuracy: bool = True
    """Measure the drift by window length."""
    memory_robots: int = 4096
    """Robots of the memory figure (compiled, not run)."""
    brian2_python: Path | None = None
    """Interpreter with brian2, for the peer's row."""
    record: bool = False
    """Write results/study_snn_speed.json."""


def cpu_time(call: Callable[[], Any], repeats: int) -> float:
    """Median CPU time of a call that has been compiled already [s]."""
    import jax

    times = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(call())
        times.append(time.process_time() - start)
    return sorted(times)[len(times) // 2]


def gemm_peak(repeats: int) -> float:
    """GFLOP/s of a float32 product of two 1024 x 1024 matrices."""
    import jax
    import jax.numpy as jnp

    a = jnp.ones((1024, 1024), jnp.float32)
    product = jax.jit(lambda x: x @ x)
    product(a).block_until_ready()
    return 2 * 1024**3 / cpu_time(lambda: product(a), 4 * repeats) / 1e9


def flops_per_robot_ms(n_in: int, n_hidden: int, window: int) -> float:
    """Multiply-adds of the matrix products, counted twice, per robot and step."""
    inputs = 2 * n_in * n_hidden
    small = min(n_in, n_hidden)
    pairs = 4 * (window + 1) * (window + 1) * small / window
    learning = 4 * (window + 1) * n_in * n_hidden / window
    return inputs + pairs + learning


def window_program(robots: int, bench: Bench, control_steps: int) -> tuple[Any, tuple, Any]:
    """A jitted phase of exactly `control_steps` steps per robot, its arguments and config."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import scenarios
    from jaxsnn.agents import snn_agent, snn_params
    from jaxsnn.presets import preset
    from jaxsnn.trials import run_phase

    size = {"control_steps": bench.window, "hold_steps": bench.window}
    config, constants = preset("S4", "tuned", config=size)
    agent, params = snn_agent(config), snn_params(config, constants)
    # A robot that stands still neither arrives nor collides: every trial has all its steps.
    map = scenarios.scenario(1)._replace(speed=jnp.zeros(()))
    block = min(bench.block, robots)

    def run(states: Any, keys: Any) -> Any:
        def one(xs: tuple) -> tuple:
            return run_phase(
                agent, params, map, xs[0], keys=xs[1], n_trials=1, max_steps=control_steps
            )  # fmt: skip

        cut = jax.tree.map(
            lambda x: x.reshape(robots // block, block, *x.shape[1:]), (states, keys)
        )
        states, result = jax.lax.map(one, cut)
        return jax.tree.map(lambda x: x.reshape(robots, *x.shape[2:]), states), result.steps

    keys = jax.random.split(jax.random.key(0), robots)
    make = jax.jit(jax.vmap(lambda k: agent.init(k, params)))
    return jax.jit(run, donate_argnums=0), (make, keys), config


def bench_window(robots: int, bench: Bench) -> float:
    """Robot-ms per CPU-second of the window form in a closed loop."""
    # States are copied in and out once per call: with few control steps that would be measured.
    control_steps = max(16, bench.control_steps * 64 // robots)
    run, (make, keys), config = window_program(robots, bench, control_steps)
    state, steps = run(make(keys), keys)
    held = [state]

    def call() -> Any:
        held[0], done = run(held[0], keys)
        return done

    seconds = cpu_time(call, bench.repeats)
    return float(steps.sum()) * config.control_steps / seconds


def bench_step(robots: int, bench: Bench) -> float:
    """Robot-ms per CPU-second of the per-step form, without a world.

    The additive rule: an exponential per synapse and step would flatter the window.
    """
    import jax
    import jax.numpy as jnp

    from jaxsnn import network
    from jaxsnn.encoding import poisson_spikes
    from jaxsnn.presets import preset

    config, params = preset("S3", "tuned")
    length = 50

    def one(state: Any, key: Any) -> Any:
        pre = poisson_spikes(jnp.full(config.n_in, 50.0), length, key=key, dt=config.dt)

        def body(carry: Any, x: Any) -> tuple:
            return network.step(config, params, carry, x, jnp.array([1.0, -1.0]))

        return jax.lax.scan(body, state, pre)[0]

    run = jax.jit(jax.vmap(one), donate_argnums=0)
    keys = jax.random.split(jax.random.key(0), robots)
    held = [jax.jit(jax.vmap(lambda k: network.init(k, config, params)))(keys)]

    def call() -> Any:
        held[0] = run(held[0], keys)
        return held[0]

    call()
    return robots * length / cpu_time(call, bench.repeats)


def memory_per_robot(bench: Bench) -> dict[str, float]:
    """Bytes per robot: the state, and the peak of the compiled phase of many robots."""
    import jax

    run, (make, keys), _ = window_program(bench.memory_robots, bench, 2)
    shapes = jax.eval_shape(make, keys)
    state = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes)) / bench.memory_robots
    analysis = run.lower(shapes, keys).compile().memory_analysis()
    total = (
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        + analysis.temp_size_in_bytes
        - analysis.alias_size_in_bytes
    )
    return {"state": float(state), "peak": total / bench.memory_robots}


def accuracy_rows(seconds: float = 2.0) -> list[dict[str, Any]]:
    """Correlation and slope of the weights' change, held windows against every step."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import network
    from jaxsnn.encoding import poisson_spikes
    from jaxsnn.presets import preset

    steps = round(seconds * 1000)
    reward = jnp.array([1.0, -1.0])
    rows = []
    for speed, gamma in (("slow", 3e-4), ("fast", 3e-3)):
        changes: dict[int, tuple[Any, float]] = {}
        for hold in (1, 10, 50, 100):
            config, params = preset(
                "S4", "tuned",
                config={"control_steps": hold, "hold_steps": hold},
                params={"gamma": gamma, "homeostasis": 0.0, "centring": 0.0},
                stdp={"anti_causal": 1.0},
            )  # fmt: skip

            def run(params: Any, config: Any = config, hold: int = hold) -> Any:
                state = network.init(jax.random.key(0), config, params)
                rates = jnp.repeat(jnp.array([50.0, 100, 50, 0, 50, 50, 25]), 30)
                pre = poisson_spikes(rates, steps, key=jax.random.key(1), dt=config.dt)
                start = state.weights.hidden
                if hold == 1:
                    end, _ = jax.lax.scan(
                        lambda c, x: network.step(config, params, c, x, reward), state, pre
                    )
                else:
                    stdp = network.kernel(config, params)

                    def body(carry: Any, x: Any) -> tuple:
                        carry, held, _ = network.window(config, params, stdp, carry, x)
                        new = network.reinforce(config, params, carry.weights, held, reward)
                        return carry._replace(weights=new), None

                    end, _ = jax.lax.scan(body, state, pre.reshape(-1, hold, config.n_in))
                return end.weights.hidden - start, jnp.mean(start)

            constants = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
            change, mean = jax.jit(run)(constants)
            changes[hold] = np.asarray(change, np.float64).ravel(), float(mean)
        exact, mean = changes[1]
        for hold in (10, 50, 100):
            got = changes[hold][0]
            rows.append(
                {
                    "learning": speed,
                    "hold_ms": hold,
                    "drift": float(np.abs(exact).mean() / mean),
                    "correlation": float(np.corrcoef(exact, got)[0, 1]),
                    "slope": float(exact @ got / (exact @ exact)),
                }
            )
    return rows


def brian2_speed(python: Path) -> dict[str, Any]:
    """The peer's closed loop, in a process of its own."""
    script = repository.ROOT / "tests" / "reference" / "snn_brian2_speed.py"
    out = subprocess.run([str(python), str(script)], check=True, capture_output=True, text=True)
    return dict(json.loads(out.stdout.strip().splitlines()[-1]))


def main(bench: Bench) -> dict[str, Any]:
    """Measure, print a table, return the numbers."""
    enable_compilation_cache()
    if bench.robots and min(bench.robots) < 1:
        raise ValueError(f"robots = {bench.robots}: expected batches of at least one robot")
    for n in bench.robots:
        if n % min(bench.block, n):
            raise ValueError(f"robots = {n} is no multiple of block = {bench.block}")
    peak = gemm_peak(bench.repeats)
    out: dict[str, Any] = {"gemm_peak_gflops": peak, "window_ms": bench.window}
    print(f"GEMM peak {peak:.0f} GFLOP/s")
    work = flops_per_robot_ms(210, 208, bench.window)
    out["step"] = {n: bench_step(n, bench) for n in (1, 16)}
    for n, speed in out["step"].items():
        print(f"per-step form, {n:4d} robots, no world: {speed:9.0f} robot-ms/s")
    out["window"] = {}
    for n in bench.robots:
        speed = bench_window(n, bench)
        out["window"][n] = speed
        print(
            f"window form,   {n:4d} robots, closed loop: {speed:9.0f} robot-ms/s, "
            f"{100 * speed * work / peak / 1e9:.0f} % of the GEMM peak, "
            f"{speed / out['step'][16]:.1f} x per-step"
        )
    out["memory_bytes_per_robot"] = memory_per_robot(bench)
    print("memory per robot [kB]:", {k: round(v / 1e3) for k, v in
                                     out["memory_bytes_per_robot"].items()})  # fmt: skip
    if bench.brian2_python is not None:
        out["brian2"] = brian2_speed(bench.brian2_python)
        ratio = max(out["window"].values()) / out["brian2"]["robot_ms_per_s"]
        print(f"Brian 2 closed loop: {out['brian2']['robot_ms_per_s']:.0f} robot-ms/s, "
              f"ours is {ratio:.0f} x")  # fmt: skip
        out["ratio_brian2"] = ratio
    if bench.accuracy:
        out["accuracy"] = accuracy_rows()
        for row in out["accuracy"]:
            print(row)
    if bench.record:
        write_json(
            repository.RESULTS / "study_snn_speed.json",
            {"table": "study_snn_speed", "title": "Speed, memory and accuracy of the SNN",
             **provenance(), **out},
        )  # fmt: skip
    return out


def fields(out: dict[str, Any]) -> dict[str, float]:
    """What the result line says."""
    speeds = {f"robot_ms_per_s_{n}": v for n, v in out["window"].items()}
    return {"gemm_gflops": out["gemm_peak_gflops"], **speeds}


if __name__ == "__main__":
    run_command(Bench, main, description=__doc__, fields=fields)
