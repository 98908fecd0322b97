"""A function of one's own: from Python, from the shell, with every kind of axis."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snn_fusion_failure.commands import sweep as command
from snn_fusion_failure.runs import WorkFailedError, repository
from snn_fusion_failure.sweeps import (
    Metric,
    categorical,
    choice,
    grid,
    integers,
    loguniform,
    sweep,
    uniform,
)

pytestmark = pytest.mark.relaxed

TRACES: list[Any] = []


def trial(params: dict[str, Any], key: Any) -> dict[str, Any]:
    """A trial with a size, a word, a label, a whole number and two numbers."""
    TRACES.append(params["width"])
    x = jax.random.normal(key, (params["width"],))
    size = jnp.abs(x).mean() if params["norm"] == "one" else jnp.sqrt((x * x).mean())
    shaped = jax.lax.switch(params["shape"], [lambda v: v, lambda v: -v], size)
    return {"size": params["gamma"] * shaped, "depth": params["depth"] + 0, "width": 1.0 * x.size}


def test_every_kind_of_axis_at_once(tmp_path) -> None:
    TRACES.clear()
    space = {
        "gamma": loguniform(1.0, 10.0),
        "width": choice(4, 8),
        "norm": choice("one", "two"),
        "shape": categorical("up", "down"),
        "depth": integers(1, 3),
    }

    def named(params: Any, key: Any) -> dict[str, Any]:
        found = trial(params, key)
        return {"size": found["size"], "deep": found["depth"], "wide": found["width"]}

    data = sweep(named, space, seeds=2, samples=12, out=tmp_path, chunk_size=4)
    assert data.attrs["objective"] == "size"
    for i in range(12):
        at = data.isel(setting=i)
        np.testing.assert_array_equal(at["wide"], float(at["width"]))
        np.testing.assert_array_equal(at["deep"], float(at["depth"]))
        sign = 1.0 if str(at["shape"].values) == "up" else -1.0
        assert (sign * at["size"] > 0).all()
    # One compiled program per pair of static values: a trace for each, and those of the check.
    pairs = {(int(w), str(n)) for w, n in zip(data["width"].values, data["norm"].values,
                                              strict=True)}  # fmt: skip
    assert len(TRACES) <= 4 * len(pairs) + 2  # two checks, a compilation and its batch


def test_the_five_lines_of_the_page(tmp_path, monkeypatch) -> None:
    page = (repository.ROOT / "docs" / "sweeps.md").read_text(encoding="utf-8")
    code = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)

    def one(params: Any, key: Any) -> dict[str, Any]:
        x = jax.random.normal(key, (params["width"],))
        return {"score": params["gamma"] * x.mean() / params["tau_z"]}

    held: dict[str, Any] = {"trial": one}
    exec(compile(code, "page", "exec"), held)
    data = held["data"]
    assert data.sizes == {"setting": 64 * 3, "seed": 8}
    assert set(data["tau_z"].values) == {5.0, 25.0, 100.0} and set(data["width"].values) == {32, 64}


def test_the_study_of_the_page(tmp_path, monkeypatch) -> None:
    """The page's example of a study with options is one, and its options are static axes."""
    page = (repository.ROOT / "docs" / "sweeps.md").read_text(encoding="utf-8")
    blocks = [part.split("```")[0] for part in page.split("```python\n")[1:]]
    (code,) = [block for block in blocks if "def make" in block]
    (tmp_path / "page_study.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    config = command.Config(
        study="page_study:make", grid=("width=1,3", "n=50,100"), seeds=4, quiet=True,
        chunk_size="4", out=Path("out"),
    )  # fmt: skip
    command.main(config)
    held = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert held["where"] == str(tmp_path) and held["metrics"]["spread"]["goal"] == "min"
    kinds = {a["leaf"]: a["kind"] for a in held["settings"]["axes"]}
    assert kinds == {"width": "float", "n": "static"}


def test_a_trial_of_this_directory_is_found_and_a_hidden_one_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "__init__.py").write_text("raise RuntimeError('not ours')\n")
    (tmp_path / "own_trial.py").write_text("def t(params, key):\n    return {'y': params['a']}\n")
    config = command.Config(study="own_trial:t", grid=("a=1,2",), seeds=1, quiet=True,
                            chunk_size="2", out=Path("out"), goal="min")  # fmt: skip
    found = command.main(config)
    assert found["best"] == 1.0 and found["a"] == 1.0
    (tmp_path / "numpy.py").write_text("def t(params, key):\n    return {'y': params['a']}\n")
    with pytest.raises(ValueError, match=r"expected numpy\.py of this directory"):
        command.main(dataclasses.replace(config, study="numpy:t", out=Path("b")))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trial": lambda p, k: 3.0}, "returned float, expected a dict"),
        ({"trial": lambda p, k: {"y": jnp.zeros(3)}}, r"dict of scalars; got y\[3\]"),
        ({"trial": lambda p, k: {"y": p["b"]}}, "KeyError: 'b'"),
        ({"trial": lambda p, k: {"a": p["a"]}}, "metric='a': expected a name that no axis has"),
        ({"space": {"a": (1, 2)}}, r"expected grid\(...\)"),
        ({"objective": "z"}, "metric=z: expected one of y"),
        ({"goal": "least"}, "goal='least'"),
        ({"space": {"a": uniform(0, 1)}}, "a grid needs a count"),
        ({"metrics": {"q": Metric()}}, "metric=q: expected one of y"),
    ],
)
def test_what_makes_no_sweep_is_refused_before_anything_is_made(tmp_path, change, message) -> None:
    given: dict[str, Any] = {"trial": lambda p, k: {"y": p["a"]}, "space": {"a": grid(1, 2)}}
    given |= change
    with pytest.raises(ValueError, match=message):
        sweep(given.pop("trial"), given.pop("space"), out=tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


def test_failed_trials_are_an_exception_and_kept(tmp_path) -> None:
    def host(a: Any) -> Any:
        if (a == 2.0).any():
            raise OverflowError("a is two")
        return a

    def raising(params: Any, key: Any) -> dict[str, Any]:
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        return {"y": jax.pure_callback(host, shape, params["a"], vmap_method="expand_dims")}

    with pytest.raises(WorkFailedError, match=r"4 of 4 trials, 2 failed.*a is two"):
        sweep(raising, {"a": grid(1, 2)}, seeds=2, out=tmp_path, chunk_size=2)
