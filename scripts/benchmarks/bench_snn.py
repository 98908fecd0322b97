"""Speed, memory and accuracy of the network's two forms, as ratios from one run.

    taskset -c 0 python scripts/benchmarks/bench_snn.py
    taskset -c 0 python scripts/benchmarks/bench_snn.py --brian2-python PATH/TO/python --record

Unit: robot-milliseconds per CPU-second (one robot, 1 ms, all 44,308 synapses of S4 plastic), world
and learning included, robots in blocks. Also the per-step form, the share of the GEMM peak, the
memory per robot, where the time of a window goes, the same network put together by
`jaxsnn.declared`, the engine "native" beside XLA's, and how far weights held for a window drift
from weights that change every millisecond. CPU time of the process, so a busy machine disturbs it
little; pin it to one core. About four CPU-minutes, half of it compiling.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.snn_drift import drift_rows
from snn_fusion_failure.records.snn_parts import WINDOWS, as_declared, by_hand, first_call
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


def window_program(
    robots: int, bench: Bench, control_steps: int, engine: str = "xla"
) -> tuple[Any, tuple, Any]:
    """A jitted phase of exactly `control_steps` steps per robot, its arguments and config."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import scenarios
    from jaxsnn.agents import snn_agent, snn_params
    from jaxsnn.presets import preset
    from jaxsnn.trials import run_phase

    size = {"control_steps": bench.window, "hold_steps": bench.window, "engine": engine}
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


def bench_window(robots: int, bench: Bench, engines: tuple[str, ...] = ("xla",)) -> list[float]:
    """Robot-ms per CPU-second of the window form in a closed loop, engines by turns."""
    import jax

    # States are copied in and out once per call: with few control steps that would be measured.
    control_steps = max(16, bench.control_steps * 64 // robots)
    runs, held = [], []
    for engine in engines:
        run, (make, keys), config = window_program(robots, bench, control_steps, engine)
        runs.append(run)
        held.append(run(make(keys), keys))
    times: list[list[float]] = [[] for _ in engines]
    work = float(held[0][1].sum()) * config.control_steps
    for _ in range(bench.repeats):
        for i, run in enumerate(runs):
            start = time.process_time()
            held[i] = jax.block_until_ready(run(held[i][0], keys))
            times[i].append(time.process_time() - start)
    return [work / sorted(t)[len(t) // 2] for t in times]


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


def _chain_speeds(programs: dict[str, Any], bench: Bench) -> dict[str, float]:
    """CPU time per robot-ms of chains of windows [us], by turns so that a busy phase hits all."""
    import jax

    keys = jax.random.split(jax.random.key(1), bench.block)
    held: dict[str, Any] = {}
    times: dict[str, list[float]] = {name: [] for name in programs}
    for name, (run, states) in programs.items():
        held[name] = jax.block_until_ready(run(states, keys))
    for _ in range(max(5, bench.repeats)):
        for name, (run, _) in programs.items():
            start = time.process_time()
            held[name] = jax.block_until_ready(run(held[name], keys))
            times[name].append(time.process_time() - start)
    unit = 1e6 / (bench.block * WINDOWS * bench.window)
    return {name: unit * sorted(t)[len(t) // 2] for name, t in times.items()}


def time_parts(bench: Bench, whole: float) -> dict[str, float]:
    """Where the CPU time of a robot-ms goes [us]; `whole` is that of the closed loop."""
    names = ("spikes", "neurons", "learning")
    took = _chain_speeds({n: by_hand(bench.block, bench.window, n) for n in names}, bench)
    parts = {
        "random input spikes": took["spikes"],
        "currents and neurons": took["neurons"] - took["spikes"],
        "eligibility and change of the weights": took["learning"] - took["neurons"],
    }
    return parts | {"world, rates, bookkeeping": whole - took["learning"], "whole": whole}


def declared_share(bench: Bench) -> dict[str, float]:
    """Robot-ms per CPU-second of the network by hand and declared, without a world."""
    took = _chain_speeds(
        {"by_hand": by_hand(bench.block, bench.window),
         "declared": as_declared(bench.block, bench.window)}, bench,
    )  # fmt: skip
    return {n: 1e6 / t for n, t in took.items()} | {"ratio": took["by_hand"] / took["declared"]}


def native_share(bench: Bench) -> dict[str, float]:
    """Robot-ms per CPU-second of `jaxsnn.native` and of the matrix products, by turns."""
    robots = min(bench.robots, key=lambda n: abs(n - 64))
    xla, native = bench_window(robots, bench, ("xla", "native"))
    return {"robots": robots, "xla": xla, "native": native, "ratio": native / xla}


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
        (speed,) = bench_window(n, bench)
        out["window"][n] = speed
        print(
            f"window form,   {n:4d} robots, closed loop: {speed:9.0f} robot-ms/s, "
            f"{100 * speed * work / peak / 1e9:.0f} % of the GEMM peak, "
            f"{speed / out['step'][16]:.1f} x per-step"
        )
        out.setdefault("share_of_peak", {})[n] = speed * work / peak / 1e9
    out["parts_us_per_robot_ms"] = time_parts(bench, 1e6 / max(out["window"].values()))
    for name, took in out["parts_us_per_robot_ms"].items():
        print(f"{name}: {took:.2f} us per robot-ms")
    out["declared"] = declared_share(bench)
    print(
        f"declared, without a world: {out['declared']['declared']:.0f} robot-ms/s, "
        f"{out['declared']['ratio']:.2f} x the network by hand"
    )
    out["native"] = native_share(bench)
    print("engine native, closed loop: {native:.0f} robot-ms/s, {ratio:.2f} x XLA's".format(
        **out["native"]))  # fmt: skip
    out["first_call_cpu_s"] = first_call()
    print(f"first call of run_experiment without a cache: {out['first_call_cpu_s']:.1f} CPU-s")
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
        out["accuracy"] = drift_rows()
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
