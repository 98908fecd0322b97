"""Speed of the circuit solver against one ngspice process per sample, per CPU-second.

    python scripts/benchmarks/bench_circuits.py [--batch 64 --repeats 5 --ngspice-samples 40]

Prints CPU time per sample of the LDO regulator (two operating points and a load step) by the JAX
solver and by ngspice (level 1, largest step 0.5 ns, as its own defaults would run it), and their
ratio; both are measured in the same run, in turns. Then the gradient of the undershoot in all 60
parameters: CPU seconds to compile it, and its cost over that of a simulation. Expect a ratio above
25 (level 1 on both sides) on one CPU core; compiling the simulation (not counted) takes 10 to 20 s,
the run itself about 10 s.
"""

from __future__ import annotations

import resource
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    run_command,
    write_json,
)


@dataclass(frozen=True)
class Config:
    """Options of the benchmark."""

    batch: int = 64
    """Samples solved side by side."""
    repeats: int = 5
    """Timings of each; the median counts."""
    ngspice_samples: int = 40
    """ngspice processes per timing."""
    max_step: float = 0.5e-9
    """Largest time step of ngspice [s]; the solver's parity is tested at 0.1e-9."""
    models: tuple[str, ...] = ("level1", "ekv")
    gradient: bool = True
    """Measure the gradient of the undershoot as well: compiling, cost, error."""
    out: Path | None = None
    """Write the result to this JSON file as well."""


def _children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(config: Config) -> dict[str, Any]:
    """Measure and return CPU seconds per sample and ratios."""
    import jax
    import numpy as np

    from failure.circuits.ldo.circuit import make_ldo
    from failure.circuits.ldo.reference import ldo_decks
    from failure.circuits.solver import ngspice

    ngspice.require()
    x = np.random.default_rng(0).normal(size=(config.batch, 60))
    decks = ldo_decks(x[: config.ngspice_samples], max_step=config.max_step, reltol=1e-3)
    circuits = {m: make_ldo(m) for m in config.models}
    for circuit in circuits.values():
        jax.block_until_ready(circuit.simulate(x))
    ours: dict[str, list[float]] = {m: [] for m in config.models}
    theirs = []
    for _ in range(config.repeats):
        for model, circuit in circuits.items():
            start = time.process_time()
            jax.block_until_ready(circuit.simulate(x))
            ours[model].append((time.process_time() - start) / config.batch)
        start = _children()
        ngspice.run_many(decks, ("iq",), workers=1)
        theirs.append((_children() - start) / len(decks))
    reference = statistics.median(theirs)
    result: dict[str, Any] = {"ngspice_ms": 1e3 * reference}
    for model in config.models:
        mine = statistics.median(ours[model])
        result[f"{model}_ms"] = 1e3 * mine
        result[f"{model}_ratio"] = reference / mine
        result[f"{model}_ratios"] = [t / o for t, o in zip(theirs, ours[model], strict=True)]
    if config.gradient:
        result |= gradient_of(circuits["ekv"] if "ekv" in circuits else make_ldo("ekv"), x, config)
    return result


def gradient_of(circuit: Any, x: Any, config: Config) -> dict[str, Any]:
    """CPU seconds to trace and compile the undershoot's gradient, its cost over a simulation of the
    same batch, and its largest distance from central differences over the largest slope."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.circuits.outputs import gradient_program

    def timed(program: Any, at: Any) -> float:
        jax.block_until_ready(program(at))
        spent = []
        for _ in range(config.repeats):
            start = time.process_time()
            jax.block_until_ready(program(at))
            spent.append(time.process_time() - start)
        return statistics.median(spent)

    column = circuit.spec_index("undershoot")
    with jax.enable_x64(True):
        at = jnp.asarray(x)
        forward = jax.jit(circuit.run)
        # A program that is in the cache would not be compiled.
        held = jax.config.values["jax_enable_compilation_cache"]
        jax.config.update("jax_enable_compilation_cache", False)
        start = time.process_time()
        program = gradient_program(circuit, column).lower(at).compile()
        compiling = time.process_time() - start
        jax.config.update("jax_enable_compilation_cache", held)
        simulation, gradient = timed(forward, at), timed(program, at)
        (_, (_, status)), slopes = program(at)
        slopes, good = np.asarray(slopes), np.asarray(status) == 0
        error = 0.0
        for k in range(0, circuit.n_dims, 7):
            step = jnp.zeros_like(at).at[:, k].set(1e-3)
            up, down = (np.asarray(forward(at + s * step)[0])[:, column] for s in (1.0, -1.0))
            error = max(error, float(np.abs(slopes[:, k] - (up - down) / 2e-3)[good].max()))
    return {
        "gradient_compile_s": compiling,
        "gradient_ms": 1e3 * gradient / config.batch,
        "gradient_ratio": gradient / simulation,
        "gradient_error": error / float(np.abs(slopes[good]).max()),
    }


def record(config: Config) -> dict[str, Any]:
    """Write what `main` finds; returns what the result line says."""
    enable_compilation_cache()
    result = main(config)
    if config.out is not None:
        write_json(config.out, {"benchmark": "circuits", **provenance(), **result})
    return {name: value for name, value in result.items() if not isinstance(value, list)}


if __name__ == "__main__":
    run_command(Config, record, description=__doc__, fields=dict)
