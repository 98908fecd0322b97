"""What is shown of a sweep: page, comparison, Pareto front, importance, files, trackers."""

from __future__ import annotations

import dataclasses
import json
import struct
import sys
import warnings
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from snn_fusion_failure.commands import sweep
from snn_fusion_failure.commands.show_sweep import Show, show
from snn_fusion_failure.sweeps import trackers
from snn_fusion_failure.sweeps.importance import importance
from snn_fusion_failure.sweeps.page import page_data, write_page
from snn_fusion_failure.sweeps.rank import compare, pareto, rank
from tests.snn_fusion_failure.sweep_toy import NAME, load

TOY = sweep.Config(
    study=NAME, grid=("a=1,2,3", "b=0,10"), seeds=4, chunk_size="3", chunk_trials=6, quiet=True,
    common_seeds=True, tracker="tensorboard",
)  # fmt: skip


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shown")
    sweep.main(dataclasses.replace(TOY, out=out))
    return out


def test_common_seeds_are_common_and_compared_in_pairs(out) -> None:
    """a scales the same noise: a difference of two settings is exact but for that factor."""
    data = load(out)
    noise = (data["value"] - data["inner.b"]) / data["a"]
    np.testing.assert_allclose(noise - noise.isel({"a": 0, "inner.b": 0}), 0.0, atol=1e-5)
    low, high = 0, 1  # a = 1 with b = 0, 10
    found = compare(data, high, low)
    assert found["paired"] and found["n"] == 4
    np.testing.assert_allclose(found["difference"], 10.0, rtol=1e-5)
    assert found["ci95"][1] - found["ci95"][0] < 1e-4
    data.attrs["common_seeds"] = 0
    apart = compare(data, high, low)
    assert not apart["paired"] and apart["ci95"][1] - apart["ci95"][0] > 0.1
    x, y = data["value"].values.reshape(-1, 4)[[high, low]]
    np.testing.assert_allclose(apart["p"], stats.ttest_ind(x, y, equal_var=False).pvalue)


class Page(HTMLParser):
    """Addresses that a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [v or "" for k, v in attrs if k in ("src", "href")]


def test_the_page_holds_all_it_needs(out, tmp_path) -> None:
    data = load(out)
    path = write_page(data, tmp_path / "index.html", live=True)
    text = path.read_text(encoding="utf-8")
    reader = Page()
    reader.feed(text)
    assert reader.fetched == [] and "http://www.w3.org/2000/svg" in text
    assert text.count("http") == text.count("http://www.w3.org/2000/svg") + text.count("http-equiv")
    assert '<meta http-equiv="refresh"' in text and "@DATA@" not in text
    held = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert held == page_data(data)
    assert [a["name"] for a in held["axes"]] == ["a", "inner.b"]
    assert len(held["settings"]) == 6 and held["settings"][0]["valid"] == 4
    best = max(held["settings"], key=lambda s: s["metrics"]["value"])
    assert best["setting"] == rank(data)[0]["setting"]
    assert "refresh" not in write_page(data, tmp_path / "done.html").read_text()


def test_a_page_cannot_be_broken_by_a_name(out, tmp_path) -> None:
    data = load(out)
    data.attrs["title"] = "</script><script>alert(1)</script>"
    text = write_page(data, tmp_path / "x.html").read_text()
    assert "<script>alert(1)" not in text


def test_show_prints_what_is_asked_for(out, capsys) -> None:
    show(
        Show(out, pareto=("value", "positive"), compare=(1, 2), importance=True, figures=False,
             export=("csv",))
    )  # fmt: skip
    text = capsys.readouterr().out
    assert "Pareto front of value, positive:" in text
    assert "(paired over common seeds, n = 4)" in text
    assert "inner.b: 0.9" in text or "inner.b: 1.0" in text
    table = (out / "trials.csv").read_text().splitlines()
    assert len(table) == 1 + 24 and set(table[0].split(",")) >= {"a", "inner.b", "seed", "value"}
    with pytest.raises(ValueError, match="compare=1 9: expected two places of the table"):
        show(Show(out, compare=(1, 9), figures=False, page=False))
    with pytest.raises(ValueError, match="objective='time': expected one of value, positive"):
        show(Show(out, objective="time", figures=False, page=False))


def test_parquet_says_what_it_needs_or_works(out) -> None:
    from snn_fusion_failure.sweeps.export import export, frame

    data = load(out)
    try:
        path = export(data, out, "parquet")
    except ValueError as error:
        assert "pip install pyarrow" in str(error)
    else:
        assert path.stat().st_size > 0
    assert set(frame(data)["status"]) == {"ok"}


def test_watch_ends_with_the_sweep(out, capsys) -> None:
    assert show(Show(out, watch=True, every=0.01, figures=False, page=False))["result"]["complete"]
    assert capsys.readouterr().out.count("settings ranked") == 1


def grid_of(values: np.ndarray) -> xr.Dataset:
    names = [f"x{i}" for i in range(values.ndim)]
    return xr.Dataset(
        {"y": ((*names, "seed"), values[..., None], {"goal": "max", "units": "1"}),
         "status": ((*names, "seed"), np.zeros((*values.shape, 1), int))},
        {n: (n, np.arange(k, dtype=float), {"units": "1", "kind": "float", "log": 0})
         for n, k in zip(names, values.shape, strict=True)} | {"seed": [0]},
        {"objective": "y", "min_valid": 1.0, "mixed": 0},
    )  # fmt: skip


def test_importance_on_a_grid_is_the_decomposition_of_the_variance() -> None:
    a, b = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
    # Main effects 2 a and b, and a product of centred parts that is pure interaction.
    y = 2.0 * a + b + 0.5 * (a - a.mean()) * (b - b.mean())
    own_a, own_b = 4.0 * a[:, 0].var(), b[0].var()
    both = 0.25 * a[:, 0].var() * b[0].var()
    total = own_a + own_b + both
    found = importance(grid_of(y))
    np.testing.assert_allclose(found["x0"], (own_a / total, (own_a + both) / total))
    np.testing.assert_allclose(found["x1"], (own_b / total, (own_b + both) / total))


def test_importance_of_drawn_settings_names_the_axis_that_matters() -> None:
    pytest.importorskip("SALib", reason="extra `sweeps` is not installed")
    rng = np.random.default_rng(0)
    x = rng.random((200, 2))
    data = xr.Dataset(
        {"y": (("setting", "seed"), np.sin(4 * x[:, :1]), {"goal": "max", "units": "1"}),
         "status": (("setting", "seed"), np.zeros((200, 1), int))},
        {"setting": np.arange(200), "seed": [0],
         **{f"x{i}": ("setting", x[:, i], {"units": "1"}) for i in range(2)}},
        {"objective": "y", "min_valid": 1.0},
    )  # fmt: skip
    found = importance(data)
    assert found["x0"][0] > 0.8 and found["x1"][0] < 0.2 and found["x0"][1] is None


def test_the_front_has_what_nothing_beats() -> None:
    data = grid_of(np.array([1.0, 3.0, 2.0, 3.0]))
    data["cost"] = (("x0", "seed"), np.array([[1.0], [2.0], [1.5], [3.0]]),
                    {"goal": "min", "units": "1"})  # fmt: skip
    assert pareto(data, ["y", "cost"]) == [1, 2, 0]


def test_a_tracker_gets_every_setting_once(out) -> None:
    """The event file, read without TensorBoard: records of length, checksum, protocol buffer."""
    from tensorboardX.proto.event_pb2 import Event

    (path,) = (out / "tensorboard").iterdir()
    data, at, seen = path.read_bytes(), 0, []
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        event = Event.FromString(data[at + 12 : at + 12 + length])
        seen += [(v.tag, event.step, v.simple_value) for v in event.summary.value]
        at += 12 + length + 4
    values = sorted((step, value) for tag, step, value in seen if tag == "value")
    wanted = load(out)["value"].mean("seed").values.ravel()
    assert [step for step, _ in values] == list(range(6))
    np.testing.assert_allclose([v for _, v in values], wanted, rtol=1e-5)


@pytest.mark.parametrize("library", ["mlflow", "wandb"])
def test_a_tracker_without_its_library_names_it(
    library: Any, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=f"tracker='{library}': expected the library {library}"):
        sweep.main(dataclasses.replace(TOY, out=out, tracker=library))


class Gone:
    """A tracker whose server goes away."""

    def __init__(self, _: object) -> None:
        pass

    def log(self, *_: object) -> None:
        raise OSError("server is gone")

    def close(self) -> None:
        pass


def test_a_tracker_that_ends_does_not_end_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(trackers.TRACKERS, "tensorboard", (Gone, "tensorboardX"))
    with pytest.warns(UserWarning, match="server is gone"):
        sweep.main(dataclasses.replace(TOY, out=tmp_path / "new"))
    assert bool(load(tmp_path / "new")["value"].notnull().all())


def test_a_tracker_that_does_not_start_says_why(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> None:
        raise RuntimeError("no account")

    monkeypatch.setitem(trackers.TRACKERS, "tensorboard", (refuse, "tensorboardX"))
    with pytest.raises(ValueError, match="to start; set it up or do without; no account"):
        sweep.main(dataclasses.replace(TOY, out=out))


def test_mlflow_gets_every_setting(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="extra `mlflow` is not installed")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    mlflow.set_tracking_uri(f"file:{tmp_path}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MLflow's own, of its file store.
        sweep.main(dataclasses.replace(TOY, out=out, tracker="mlflow"))
        runs = mlflow.search_runs(search_all_experiments=True, output_format="list")
    found = sorted(r.data.metrics["value"] for r in runs if r.data.metrics)
    wanted = np.sort(load(out)["value"].mean("seed").values.ravel())
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_wandb_takes_a_study_of_one_s_own(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb", reason="extra `wandb` is not installed")
    for name, value in (("WANDB_MODE", "offline"), ("WANDB_DIR", str(tmp_path))):
        monkeypatch.setenv(name, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sweep.main(dataclasses.replace(TOY, out=out, tracker="wandb"))
    (file,) = tmp_path.rglob("*.wandb")
    assert file.stat().st_size > 0
