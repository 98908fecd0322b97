"""Sweeps: layouts agree, folders are joined and refused, trials break and are said to have."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.sweeps import definition, designs, folder, gather, plan, program, rungs
from snn_fusion_failure.sweeps.chunks import run_shard
from snn_fusion_failure.sweeps.folder import done_chunks, held_sweep
from snn_fusion_failure.sweeps.results import Reader
from tests.snn_fusion_failure.sweep_toy import NAME, NO_BUDGET

LIF = sweep.Config(
    study="lif", options=("steps=60",), grid=("drive=18:40:5", "tau_m=5,20,40"), seeds=3,
    chunk_size="2", chunk_trials=6, quiet=True,
)  # fmt: skip
TOY = sweep.Config(
    study=NAME, grid=("a=1,2,3,4", "b=0,10"), seeds=3, chunk_size="3", chunk_trials=6, quiet=True
)


def run(config: sweep.Config, out: Path, **changes: Any) -> xr.Dataset:
    sweep.main(dataclasses.replace(config, out=out, **changes))
    return load(out)


def load(out: Path) -> xr.Dataset:
    with xr.open_dataset(out / "results.nc") as data:
        return data.load()


@pytest.fixture(scope="module")
def lif(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    with jax.numpy_dtype_promotion("strict"):
        return run(LIF, tmp_path_factory.mktemp("lif"))


def same(a: xr.Dataset, b: xr.Dataset) -> None:
    for name in a.data_vars:
        np.testing.assert_array_equal(a[name], b[name], err_msg=str(name))


def test_one_shard_is_four_shards(lif, tmp_path) -> None:
    order = (2, 0, 3, 1)
    ended = [
        sweep.main(dataclasses.replace(LIF, out=tmp_path, shard=f"{i}/4"))["complete"]
        for i in order
    ]
    assert ended == [False, False, False, True]
    same(load(tmp_path), lif)


@pytest.mark.parametrize(("size", "per_file"), [("1", 5), ("all", 0), ("7", 45), ("4", 9)])
def test_chunk_size_does_not_change_numbers(lif, tmp_path, size, per_file) -> None:
    same(run(LIF, tmp_path, chunk_size=size, chunk_trials=per_file), lif)


def test_numbers_are_those_of_the_setting_and_the_seed_alone(tmp_path) -> None:
    data = run(TOY, tmp_path)
    assert data["value"].dims == ("a", "inner.b", "seed")
    for a, b, seed in ((1.0, 0.0, 0), (2.0, 0.0, 1), (4.0, 10.0, 2)):
        first, second = designs.digest(["a", "inner.b"], [a, b])
        key = jax.random.key(0)
        for word in (first, second, seed):
            key = jax.random.fold_in(key, word)
        wanted = a * float(jax.random.normal(key, (4,)).mean()) + b
        got = data["value"].sel({"a": a, "inner.b": b, "seed": seed})
        np.testing.assert_allclose(got, wanted, rtol=1e-6)


def test_data_set_says_what_it_is(lif) -> None:
    assert dict(lif.sizes) == {"drive": 5, "neuron.tau_m": 3, "seed": 3}
    assert lif["rate"].attrs["units"] == "Hz"
    assert lif["neuron.tau_m"].attrs["units"] == "ms"
    assert (lif["status"] == definition.OK).all()
    config, made = json.loads(lif.attrs["config"]), json.loads(lif.attrs["provenance"])
    assert config["study"] == "lif" and config["options"]["steps"] == 60
    assert {"jax", "numpy", "python"} <= set(made["versions"])
    # A neuron above threshold fires at the rate that its equation has; steps of 1 ms round it.
    strong = lif["rate"].sel({"drive": 40.0, "neuron.tau_m": 20.0}).mean()
    exact = 1.0 / (2e-3 + 20e-3 * np.log(40.0 / (40.0 - 15.0)))
    np.testing.assert_allclose(strong, exact, rtol=0.25)


@pytest.mark.parametrize("kind", ["random", "sobol"])
def test_sampled_designs(tmp_path, kind) -> None:
    axes = ("a=1:2:log", "inner.time=5:100")
    data = run(TOY, tmp_path, grid=(), samples=5, **{kind: axes})
    assert dict(data.sizes) == {"setting": 5, "seed": 3}
    assert data["a"].dims == ("setting",)
    # 5 ms are 0.005 s in the code.
    swept = np.broadcast_to(data["inner.time"].values[:, None], (5, 3))
    np.testing.assert_allclose(data["time"] * 1e3, swept, rtol=1e-6)


def test_a_sweep_goes_on_and_repeats_nothing(tmp_path) -> None:
    data = run(TOY, tmp_path)
    files = sorted((tmp_path / "chunks").iterdir())
    before = [p.stat().st_mtime_ns for p in files]
    files[1].unlink()
    (tmp_path / "chunks" / ".000002.npz.torn").write_bytes(b"PK")  # a writer was killed here
    (tmp_path / "results.nc").unlink()
    same(run(TOY, tmp_path), data)
    after = [p.stat().st_mtime_ns for p in files]
    assert [b == a for b, a in zip(before, after, strict=True)] == [True, False, True, True]


def test_other_settings_are_refused(tmp_path) -> None:
    run(TOY, tmp_path)
    for changes, message in [
        ({"seeds": 2}, r"seeds=2: expected at least the 3 .* grow, not shrink"),
        ({"options": ("length=5",)}, r"other settings \(length: 4 -> 5.*--overwrite"),
        ({"grid": ("a=1,2", "b=0,10")}, r"4 settings that are not asked for .*a=1.0,2.0,3.0,4.0"),
        ({"grid": ("a=1,2,3,4", "time=1")}, r"axes: a inner.b -> a inner.time"),
        ({"root": 1}, r"other settings \(root: 0 -> 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            run(TOY, tmp_path, **changes)
    (tmp_path / "notes.txt").write_text("mine")
    data = run(TOY, tmp_path, seeds=1, overwrite=True)
    assert data.sizes["seed"] == 1 and (tmp_path / "notes.txt").exists()
    # The chunk size is the folder's: it does not change numbers.
    sweep.main(dataclasses.replace(TOY, seeds=1, out=tmp_path, chunk_size="1"))
    assert held_sweep(tmp_path).width == 3


def test_trials_that_break_are_recorded(tmp_path) -> None:
    data = run(TOY, tmp_path, options=("bad=2.0",))
    status = data["status"]
    assert (status.sel(a=2.0) == definition.NON_FINITE).all()
    assert (status.sel(a=[1.0, 3.0, 4.0]) == definition.OK).all()
    # An optional metric may be NaN in a good trial.
    assert np.isnan(data["positive"].sel(a=[1.0, 3.0, 4.0])).any()


def test_a_chunk_that_raises_is_recorded_and_run_again(tmp_path) -> None:
    flag = tmp_path / "flag"
    flag.touch()
    out = tmp_path / "out"
    config = dataclasses.replace(TOY, options=(f"broken_while={flag}",), out=out)
    result = sweep.main(config)
    assert result["complete"] and result["failed"] == 6 and result["trials"] == 24
    assert result["missing"] == 0
    data = load(out)
    assert (data["status"].sel(a=3.0) == definition.FAILED).all()
    assert np.isnan(data["value"].sel(a=3.0)).all()
    assert "a is three" in json.loads(data.attrs["failures"])["4/0"]
    assert sweep.main(config)["failed"] == 6  # recorded: not tried again by itself
    flag.unlink()
    assert sweep.main(dataclasses.replace(config, retry_failed=True))["failed"] == 0
    same(load(out), run(TOY, tmp_path / "whole"))


def test_auto_measures_and_notes_it(lif, tmp_path, capsys) -> None:
    same(run(LIF, tmp_path, chunk_size="auto", chunk_trials=4), lif)
    layout = json.loads((tmp_path / "sweep.json").read_text())["layout"]
    seconds = {int(k): v for k, v in layout["measured_seconds_per_trial"].items()}
    assert list(seconds)[:2] == [1, 4] and layout["chunk_size"] == program.fastest(seconds)
    assert "measured per trial 1: " in capsys.readouterr().err


def test_auto_stops_where_it_gets_slower() -> None:
    ticks = iter([0.0, 1.0, 0.0, 2.0, 0.0, 80.0])
    study = held_study()
    words = np.zeros((64, 2), np.uint32)
    seconds = program.measure_widths(
        study, {"a": np.arange(64.0)}, words, np.arange(64), root=0, clock=lambda: next(ticks)
    )
    assert seconds == {1: 1.0, 4: 0.5, 16: 5.0}
    assert program.fastest(seconds) == 4


def held_study() -> Any:
    from snn_fusion_failure.sweeps.study import load_study

    return load_study(NAME)


def test_halving_keeps_the_numbers_of_survivors(tmp_path) -> None:
    whole = run(TOY, tmp_path / "whole")
    halved = run(TOY, tmp_path / "halved", halving=(1, 2), keep=0.5)
    budget = halved["budget"].values.reshape(8, 3)
    assert [int((budget[:, 0] == b).sum()) for b in (1, 2)] == [4, 2]
    last = halved["status"] == definition.OK
    assert int(last.sum()) == 2 * 3
    np.testing.assert_array_equal(
        halved["value"].values[last.values], whole["value"].values[last.values]
    )
    assert np.isnan(halved["value"].values[~last.values]).all()
    # Who went on follows from the scores of the rung below.
    held = held_sweep(tmp_path / "halved")
    found = Reader(held.out).found(held, plan.segments_of(plan.read_plan(held.out)), 8, 1)
    scores = rungs.setting_scores(found.metrics["value"], found.status, "max", 0.75)
    kept = np.flatnonzero(budget[:, 0] >= 2)
    assert set(kept) == set(np.argsort(-scores, kind="stable")[:4])


def test_halving_by_shards_is_halving(tmp_path) -> None:
    one = run(TOY, tmp_path / "one", halving=(1,), keep=0.5)
    config = dataclasses.replace(TOY, out=tmp_path / "two", halving=(1,), keep=0.5)
    ended = [sweep.main(dataclasses.replace(config, shard=f"{i % 2}/2")) for i in range(3)]
    assert [e["complete"] for e in ended] == [False, False, True]
    same(load(tmp_path / "two"), one)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"halving": (5, 5)}, "expected growing numbers of normals"),
        ({"halving": (5,), "keep": 1.0}, "keep=1.0"),
        ({"grid": ()}, "no axis given"),
        ({"random": ("a=1:2",), "sobol": ("b=1:2",)}, "random and sobol given"),
        ({"seeds": 0}, "seeds=0"),
        ({"chunk_size": "0"}, "chunk_size='0'"),
        ({"shard": "4/4"}, "shard='4/4': expected i/n"),
        ({"shard": "0/4", "workers": 2}, "--shard is one process"),
        ({"grid": ("c=1,2",)}, "'c' is no leaf of this study.*a, inner.b, inner.time"),
        ({"study": "lif", "grid": ("tau_m=0.4",)}, "dt=0.001: expected a step below 2 tau_m"),
        ({"study": NO_BUDGET, "halving": (1,)}, "no budget to cut"),
    ],
)
def test_what_cannot_run_is_refused_first(tmp_path, changes, message) -> None:
    with pytest.raises(ValueError, match=message):
        sweep.main(dataclasses.replace(TOY, out=tmp_path / "out", **changes))
    assert not (tmp_path / "out").exists()


def test_claims_at_the_same_time_agree(tmp_path) -> None:
    made = sweep.build(dataclasses.replace(TOY, out=tmp_path))
    first = folder.claim(dataclasses.replace(made, width=2, chunk_trials=4))
    second = folder.claim(dataclasses.replace(made, width=3, chunk_trials=6))
    assert (second.width, second.chunk_trials) == (first.width, first.chunk_trials) == (2, 4)
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.json"]  # no temporary file is left
    with pytest.raises(ValueError, match="holds no sweep"):
        held_sweep(tmp_path / "nowhere")


def test_show(tmp_path, capsys) -> None:
    run(TOY, tmp_path, options=("bad=4.0",))
    result = sweep.show(sweep.Show(tmp_path, top=3))["result"]
    text = capsys.readouterr().out
    assert "18 ok, 6 non-finite, 0 failed, 0 missing" in text
    assert (tmp_path / "heat_a_inner.b.png").stat().st_size > 5000
    assert (tmp_path / "parallel.png").stat().st_size > 5000
    assert result["inner.b"] == 10.0 and result["complete"]
    best = text.splitlines()[1].split()
    assert best[0] == "1" and best[2] == "10" and best[-2:] == ["3", "0"]
    data = load(tmp_path)
    mean = float(data["value"].sel({"a": result["a"], "inner.b": 10.0}).mean())
    assert result["best"] == pytest.approx(mean)
    # Half done: shown as far as it is.
    folder.chunk_path(tmp_path, 0, 0).unlink()
    half = sweep.show(sweep.Show(tmp_path, figures=False))["result"]
    assert not half["complete"] and half["trials"] == 18
    with pytest.raises(SystemExit):
        sweep.cli(["show", str(tmp_path / "nothing")])
    assert "holds no sweep" in capsys.readouterr().err


def test_goals_that_count_down_rank_the_other_way(lif) -> None:
    from snn_fusion_failure.sweeps.rank import rank

    means = [row["mean"] for row in rank(lif)]
    assert means == sorted(means) and len(means) == 15


def test_gather_of_an_empty_folder_is_all_missing(tmp_path) -> None:
    made = folder.claim(sweep.build(dataclasses.replace(TOY, out=tmp_path)))
    rungs.grow(made)
    held = held_sweep(tmp_path, load=True)
    data = gather.gather(held)
    assert (data["status"] == definition.MISSING).all() and not data.attrs["complete"]
    assert done_chunks(tmp_path) == set()
    assert not run_shard(held, shard=0, shards=24, exclusive=True).complete
