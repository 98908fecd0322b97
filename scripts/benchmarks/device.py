"""One prepared run for an accelerator: what was never measured on one, most valuable first.

    python scripts/benchmarks/device.py --minutes 8 --out OUT
    python scripts/benchmarks/device.py --tiny --out OUT   # a CPU, the smallest sizes

Each part runs in a process of its own within what is left of the time, and writes OUT/PART.json as
soon as it ends: parity of the golden tests at highest precision; steps of a batch of spiking
networks, with the share of the device's memory bandwidth; training of the HAR network with seeds
side by side; circuit samples; the detector's stages; a sweep over all devices. A missing device,
package or data set, or a part that ran out of time, is a line in its file, not a crash.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import provenance, repository, run_command, write_json


@dataclasses.dataclass(frozen=True)
class Config:
    """What to run and for how long."""

    out: Path = Path("runs/device")
    """Folder of the parts' files."""
    minutes: float = 8.0
    """For all parts together."""
    tiny: bool = False
    """The smallest sizes, for a CPU."""
    parts: tuple[str, ...] = ()
    """Parts to run; all of them, in the order of value, when left out."""


def _timed(call: Callable[[], Any], repeats: int) -> float:
    """Median seconds of a call whose result is waited for; the first one compiles."""
    import statistics

    import jax

    jax.block_until_ready(call())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def bandwidth(tiny: bool) -> float:
    """Bytes per second that the device copies, read and write counted."""
    import jax
    import jax.numpy as jnp

    n = 2**20 if tiny else 2**28
    x = jnp.zeros(n, jnp.float32)
    add = jax.jit(lambda x: x + 1.0)
    return 8.0 * n / _timed(lambda: add(x), 5)


def parity(tiny: bool) -> dict[str, Any]:
    """The tests of golden numbers, at the highest precision of matrix products."""
    names = ["tests/fusion/test_lattice_layers.py"]
    if not tiny:
        names += [
            "tests/failure/test_gp.py",
            "tests/failure/test_ldo.py",
            "tests/failure/test_bnn.py",
        ]
    env = {**os.environ, "JAX_DEFAULT_MATMUL_PRECISION": "highest"}
    import jax

    env["JAX_PLATFORMS"] = jax.devices()[0].platform.replace("gpu", "cuda") + ",cpu"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *names]
    if tiny:
        command += ["-k", "golden"]
    done = subprocess.run(command, cwd=repository.ROOT, env=env, capture_output=True, text=True)
    lines = done.stdout.strip().splitlines()
    failed = [line for line in lines if line.startswith("FAILED")]
    return {"status": done.returncode, "summary": lines[-1] if lines else "", "failed": failed}


def robots(tiny: bool) -> dict[str, Any]:
    r"""Robot-milliseconds per second of the S4 network that learns while its robot drives.

    One robot, 1 ms, all synapses plastic, world included: `jaxsnn.run_phase` with all robots in one
    block. In each window of W ms a synapse's weight is read for the currents, its trace is read and
    written, and its weight is read and written by the reward: at least 20 bytes, so that

    .. math:: \text{rate} \le \frac{W B}{20 n}, \qquad B \text{ bytes/s copied}, n \text{ synapses}
    """
    import jax
    import jax.numpy as jnp

    from jaxsnn import preset, run_phase, scenario, snn_agent, snn_params

    size = {"hidden_exc": 12, "hidden_inh": 12, "group_exc": 4, "group_inh": 4} if tiny else {}
    window, steps = (20, 2) if tiny else (100, 8)
    config, constants = preset(
        "S4", "tuned", config={**size, "control_steps": window, "hold_steps": window}
    )
    agent, params = snn_agent(config), snn_params(config, constants)
    # A robot that stands still neither arrives nor collides: every trial has all its steps.
    map = scenario(1)._replace(speed=jnp.zeros(()))

    @functools.partial(jax.jit, donate_argnums=0)
    def drive(states: Any, keys: Any) -> Any:
        return run_phase(agent, params, map, states, keys=keys, n_trials=1, max_steps=steps)

    @jax.jit
    def begin(keys: Any) -> Any:
        return jax.vmap(lambda key: agent.init(key, params))(keys)

    copied = bandwidth(tiny)
    rows: list[dict[str, Any]] = []
    for count in (8, 16) if tiny else (1024, 2048, 4096, 8192, 16384):
        keys = jax.random.split(jax.random.key(0), count)
        try:
            held, result = drive(begin(keys), keys)
            synapses = sum(w[0].size for w in held.weights)
            seconds = []
            for _ in range(3):
                start = time.perf_counter()
                held, result = jax.block_until_ready(drive(held, keys))
                seconds.append(time.perf_counter() - start)
            done = int(result.steps.sum())
        except Exception as error:
            rows.append({"robots": count, "error": str(error).splitlines()[0][:200]})
            continue
        rate = done * window / min(seconds)
        moved = 20.0 * synapses / window
        rows.append({
            "robots": count, "robot_ms_per_s": rate, "synapses": synapses,
            "bytes_per_robot_ms": moved, "share_of_bandwidth": rate * moved / copied,
        })  # fmt: skip
        line = (
            f"{count} robots: {rate:.3g} robot-ms/s, {rate * moved / copied:.1%} of the bandwidth"
        )
        print(line, flush=True)
    return {"bytes_per_s": copied, "window_ms": window, "rows": rows}


def fusion_tables(tiny: bool) -> dict[str, Any]:
    """ARGate-L on HAR and driver windows, seeds side by side, at each data set's preset."""
    import numpy as np

    from snn_fusion_failure.sweeps.program import compile_study
    from snn_fusion_failure.sweeps.study import load_study

    found: dict[str, Any] = {}
    sets = ("simulated",) if tiny else ("har", "driver")
    for name in sets:
        options = [f"dataset={name}", "preset=quick" if tiny else "preset=paper"]
        options += ["epochs=1", "model=netgated"] if tiny else []
        seeds = np.arange(2 if tiny else 10)
        try:
            study = load_study("argate", options)
            words = np.zeros((len(seeds), 2), np.uint32)
            start = time.perf_counter()
            metrics, _ = compile_study(study, root=0, width=len(seeds))({}, words, seeds)
            found[name] = {
                "seconds_with_compiling": time.perf_counter() - start, "seeds": len(seeds),
                "accuracy_mean": float(np.mean(metrics["accuracy"])),
                "accuracy_values": metrics["accuracy"].tolist(),
            }  # fmt: skip
        except (FileNotFoundError, ValueError) as error:
            found[name] = {"missing": str(error).splitlines()[0]}
    return found


def circuit_samples(tiny: bool) -> dict[str, Any]:
    """Samples of the LDO regulator per second, by batch."""
    import jax
    import numpy as np

    from failure import circuits

    ldo = circuits.get("ldo")
    rows = []
    for batch in (2,) if tiny else (64, 512, 4096):
        x = np.random.default_rng(0).normal(size=(batch, ldo.n_dims))
        with jax.enable_x64(True):
            seconds = _timed(functools.partial(ldo.simulate, x), 1 if tiny else 3)
        rows.append({"batch": batch, "samples_per_s": batch / seconds})
    return {"rows": rows}


def detector(tiny: bool) -> dict[str, Any]:
    """Stages of the detector in frames per second, by its own benchmark."""
    if tiny:
        return {"missing": "left out at the smallest sizes: compiling alone takes minutes"}
    script = repository.ROOT / "scripts" / "benchmarks" / "bench_detector.py"
    done = subprocess.run(
        [sys.executable, str(script), "--size", "paper"], cwd=repository.ROOT,
        capture_output=True, text=True,
    )  # fmt: skip
    lines = done.stdout.strip().splitlines()
    return {"status": done.returncode, "output": lines[-12:], "error": done.stderr[-500:]}


def sweep_all_devices(tiny: bool) -> dict[str, Any]:
    """A sweep of the `lif` study over all devices."""
    import tempfile

    from snn_fusion_failure.commands import sweep

    with tempfile.TemporaryDirectory() as folder:
        config = sweep.Config(
            study="lif", options=("steps=50",) if tiny else ("steps=1000",),
            grid=("drive=16:40:4",) if tiny else ("drive=16:40:64", "tau_m=10,20,40,80"),
            seeds=2 if tiny else 64, chunk_size="8" if tiny else "auto", quiet=True,
            out=Path(folder),
        )  # fmt: skip
        start = time.perf_counter()
        found = sweep.main(config)
        seconds = time.perf_counter() - start
    return {"trials": found["trials"], "seconds": seconds, "complete": found["complete"]}


PARTS: dict[str, Callable[[bool], dict[str, Any]]] = {
    "parity": parity,
    "robots": robots,
    "fusion": fusion_tables,
    "circuits": circuit_samples,
    "detector": detector,
    "sweep": sweep_all_devices,
}
"""Parts, most valuable first."""


def run_part(name: str, config: Config, seconds: float) -> dict[str, Any]:
    """One part in a process of its own; its file says what it found or why there is nothing."""
    path = config.out / f"{name}.json"
    path.unlink(missing_ok=True)
    command = [sys.executable, __file__, "--part", name, str(path), str(int(config.tiny))]
    start = time.monotonic()
    line = ""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
        if done.returncode or not path.exists():
            errors = done.stderr.strip().splitlines()
            line = errors[-1] if errors else f"ended with {done.returncode}"
    except subprocess.TimeoutExpired:
        line = f"not done within {seconds:.0f} s"
    if line:
        write_json(path, {"part": name, "missing": line})
    elif done.stdout:
        print(done.stdout, end="", flush=True)
    found = json.loads(path.read_text(encoding="utf-8"))
    print(f"{name}: {time.monotonic() - start:.0f} s, {found.get('missing', 'done')}", flush=True)
    return dict(found)


def part_main(name: str, path: Path, tiny: bool) -> None:
    """What the process of a part does."""
    if tiny:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    from snn_fusion_failure.runs import enable_compilation_cache

    enable_compilation_cache()
    found = PARTS[name](tiny)
    write_json(path, {"part": name, **found, **provenance()})


def main(config: Config) -> dict[str, Any]:
    """Run the parts one after another; returns what each found."""
    unknown = sorted(set(config.parts) - set(PARTS))
    if unknown:
        raise ValueError(f"parts={' '.join(unknown)}: expected some of {', '.join(PARTS)}")
    config.out.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60.0 * config.minutes
    found = {}
    for name in config.parts or PARTS:
        left = end - time.monotonic()
        if left < 5.0:
            found[name] = {"part": name, "missing": "no time was left"}
            write_json(config.out / f"{name}.json", found[name])
            continue
        found[name] = run_part(name, config, left)
    return found


def fields(results: dict[str, Any]) -> dict[str, int]:
    """What the result line says."""
    return {"done": sum("missing" not in r for r in results.values()), "of": len(results)}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--part"]:
        part_main(sys.argv[2], Path(sys.argv[3]), sys.argv[4] == "1")
    else:
        run_command(Config, main, description=__doc__, fields=fields)
