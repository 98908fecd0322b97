"""A study whose numbers are known, for the sweep's tests; and what killed workers run."""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from snn_fusion_failure.sweeps.chunks import run_shard
from snn_fusion_failure.sweeps.folder import held_sweep
from snn_fusion_failure.sweeps.study import Metric, Study


class Inner(NamedTuple):
    b: float = 2.0
    time: float = 0.02


class Toy(NamedTuple):
    a: float = 1.0
    inner: Inner = Inner()


def make(
    length: int = 4, broken_while: str = "", bad: float = -1.0, delay: float = 0.0, die: str = ""
) -> Study:
    """`value = a * mean of normals + b`, NaN where `a == bad`.

    Raises inside the compiled program while the file `broken_while` is there and `a == 3`. Kills
    its own process, once, where the file `die` is there; it is removed first.
    """

    def host(a: Any) -> Any:
        if broken_while and Path(broken_while).exists() and (a == 3.0).any():
            raise OverflowError("a is three")
        if die and Path(die).exists():
            Path(die).unlink()
            os.kill(os.getpid(), 9)
        time.sleep(delay)
        return np.zeros_like(a)

    def run(params: Toy, keys: Any) -> dict[str, Any]:
        noise = jax.vmap(lambda k: jnp.mean(jax.random.normal(k, (length,))))(keys)
        value = params.a * noise + params.inner.b
        if broken_while or delay or die:
            shape = jax.ShapeDtypeStruct(params.a.shape, params.a.dtype)
            value = value + jax.pure_callback(host, shape, params.a)
        value = jnp.where(params.a == bad, jnp.nan, value)
        never = jnp.where(noise > 0.0, noise, jnp.nan)
        return {"value": value, "time": params.inner.time + 0.0 * value, "positive": never}

    return Study(
        name="toy",
        options={},
        params=Toy(),
        run=run,
        metrics={
            "value": Metric("V", "a random number", "max"),
            "time": Metric("s", "what was swept, in the code's unit"),
            "positive": Metric("", "the noise, where positive", "min", True),
        },
        objective="value",
        unit_of=lambda leaf: "ms" if leaf == "inner.time" else "",
        with_budget=lambda budget: make(budget, broken_while, bad, delay, die),
        budget_text="normals",
    )


def make_uncut() -> Study:
    """The same without a budget: there is nothing to cut a trial by."""
    return dataclasses.replace(make(), name="uncut", with_budget=None)


NAME = "tests.snn_fusion_failure.sweep_toy:make"
NO_BUDGET = "tests.snn_fusion_failure.sweep_toy:make_uncut"


def work_logged(out: str, log: str) -> None:
    """All missing chunks, with a line in `log` for every chunk that is begun."""
    with open(log, "a", buffering=1) as file:  # one write per line: a kill tears none apart

        def begun(name: str) -> None:
            file.write(f"{name}\n")

        run_shard(held_sweep(Path(out), load=True), on_start=begun)


def load(out: Path) -> xr.Dataset:
    """The results of a finished sweep."""
    with xr.open_dataset(out / "results.nc") as data:
        return data.load()


def same(a: xr.Dataset, b: xr.Dataset, *names: str) -> None:
    """Two sweeps' results are equal bit for bit, in these variables."""
    assert names
    for name in names:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
