import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from failure import circuits
from failure.circuits import Circuit, Spec
from failure.search.task import Task
from snn_fusion_failure.commands import find_failures
from snn_fusion_failure.records import failure_runs, failure_tables
from snn_fusion_failure.runs import WorkFailedError

SLOPE = np.array([1.0, -2.0, 0.5, 3.0])


def run(x):
    """A margin that shrinks along one direction; smaller is worse."""
    y = 10.0 - x @ jnp.asarray(SLOPE, x.dtype)
    return y[:, None], jnp.zeros(x.shape[0], jnp.int32)


def reference(x, **options):
    specs, status = run(jnp.asarray(x))
    return np.asarray(specs), np.asarray(status)


@pytest.fixture
def toy(monkeypatch):
    names = tuple((t, q) for t in ("M1", "M2") for q in ("length", "threshold"))
    circuit = Circuit(
        "toy", names, (0.01,) * 4, ("1", "V", "1", "V"),
        (Spec("margin", "V", "min", "what is left"),), run, reference,
    )  # fmt: skip
    monkeypatch.setitem(circuits.CIRCUITS, "toy", lambda: circuit)


@pytest.fixture
def config(tmp_path, toy):
    return find_failures.Config(
        circuit="toy", spec="margin", method="ridge_corner", seeds=2, n_init=8, n_total=12,
        threshold=-8.0, verify="ngspice", out=tmp_path / "run",
    )  # fmt: skip


def test_search_table_and_result_line(config, capsys):
    result = find_failures.main(config)
    assert result["success_rate"] == 1.0 and np.allclose(result["worst_case"], 10 - 3 * 6.5)
    # what is below -8 is at the corner: eight samples, then the corner
    assert np.all(np.asarray(result["first_failure"]) <= 12)
    assert result["verified"]["confirmed"] == result["verified"]["claimed"] > 0
    out = capsys.readouterr().out.splitlines()
    assert out[-1].startswith("result: threshold=-8 success=1 ")
    assert out[1].split() == ["transistor", "length", "threshold"]
    assert out[2].split() == ["M1", "+3.00", "-3.00"]
    table = (config.out / "failures.csv").read_text().splitlines()
    assert table[0] == "seed,simulation,margin,M1.length,M1.threshold,M2.length,M2.threshold"
    assert len(table) == 1 + result["verified"]["claimed"]
    assert (config.out / "trend.png").stat().st_size > 5000
    assert json.loads((config.out / "result.json").read_text())["unit"] == "V"


def test_a_folder_with_a_run_is_refused_resumed_or_replaced(config):
    find_failures.main(config)
    with pytest.raises(ValueError, match="pass --resume"):
        find_failures.main(config)
    with pytest.raises(ValueError, match="method: 'ridge_corner' -> 'monte_carlo'"):
        find_failures.main(dataclasses.replace(config, method="monte_carlo", resume=True))
    again = find_failures.main(dataclasses.replace(config, resume=True))
    (config.out / "threshold.json").write_text('{"threshold": 99.0}')  # of what was searched before
    other = find_failures.main(dataclasses.replace(config, seeds=1, overwrite=True))
    assert not (config.out / "threshold.json").exists()
    assert len(again["worst_case"]) == 2 and len(other["worst_case"]) == 1


def test_the_budget_grows_when_a_run_goes_on(config):
    find_failures.main(config)
    lines = (config.out / "evaluations.jsonl").read_text().splitlines()
    found = find_failures.main(dataclasses.replace(config, n_total=14, resume=True))
    grown = (config.out / "evaluations.jsonl").read_text().splitlines()
    assert grown[: len(lines)] == lines and len(grown) > len(lines)
    assert found["settings"]["n_total"] == 14
    resumed = json.loads((config.out / "config.json").read_text())["resumed"]
    assert [part["settings"] for part in resumed] == [{"n_total": 14}]
    again = dataclasses.replace(config, n_total=None, preset="quick", resume=True)
    assert find_failures.main(again)["settings"]["preset"] == "quick"
    with pytest.raises(ValueError, match="n_total: 30 -> 12"):
        find_failures.main(dataclasses.replace(config, resume=True))


@pytest.mark.parametrize("broken", ["raises", "nan"])
def test_a_function_that_never_works_is_failed_work_with_its_message(
    config, broken, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    body = {"raises": "raise KeyError('vdd')", "nan": "return float('nan')"}[broken]
    (tmp_path / f"circuit_{broken}.py").write_text(
        f"def f(x):\n    with open('calls', 'a') as calls:\n        calls.write('1')\n    {body}\n"
    )
    own = dataclasses.replace(
        config, circuit=f"circuit_{broken}:f", spec="value", dimensions=2, n_total=200, verify=None
    )
    said = {"raises": "KeyError: 'vdd'", "nan": r"status 3 \(not finite\)"}[broken]
    with pytest.raises(WorkFailedError, match=f"never worked; its last message: .*{said}"):
        find_failures.main(own)
    assert len((tmp_path / "calls").read_text()) < 200


@pytest.mark.parametrize("content", [b"", b'{"threshold": -8', b"\xe9", b"[]", b'{"nominal": 1}'])
def test_a_damaged_threshold_is_named_and_computed_again(toy, tmp_path, content):
    circuit, task = circuits.CIRCUITS["toy"](), Task("box", 3.0, 4)
    path = tmp_path / "threshold.json"
    path.write_bytes(content)
    with pytest.warns(RuntimeWarning, match=r"threshold\.json: .*; kept as threshold\.json\.d"):
        found = failure_runs.threshold_for(circuit, 0, task, tmp_path)
    # 90 % of the way from 10 to 10 - 3 * 6.5
    assert np.isclose(found, 10 - 0.9 * 3 * 6.5, atol=1e-3)
    assert failure_runs.threshold_for(circuit, 0, task, tmp_path) == found
    assert path.with_name("threshold.json.damaged").read_bytes() == content


@pytest.mark.parametrize("content", [b"", b'{"threshold": -8', b"\xe9", b"[]", b"{}"], ids=repr)
def test_a_damaged_file_of_a_study_is_named_and_computed_again(tmp_path, content):
    path = tmp_path / "probability.json"
    path.write_bytes(content)
    with pytest.warns(RuntimeWarning, match=r"probability\.json: .*; kept as probability\.json\.d"):
        assert failure_tables.cached(path, lambda: {"p": 0.5}) == {"p": 0.5}
    assert failure_tables.cached(path, dict) == {"p": 0.5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"circuit": "opamp"}, "circuit='opamp': expected one of"),
        ({"spec": "gain"}, "spec='gain': expected a specification of 'toy', one of 'margin'"),
        ({"method": "annealing"}, "known methods: monte_carlo"),
        ({"task": "cube"}, "expected 'box' or 'ball'"),
        ({"verify": "spectre"}, "expected 'ngspice'"),
        ({"seeds": 0}, "seeds=0"),
    ],
)
def test_bad_input_names_what_is_known(config, change, message):
    with pytest.raises(ValueError, match=message):
        find_failures.main(dataclasses.replace(config, **change))
    assert not config.out.exists()


def test_study_writes_rows_and_does_not_run_twice(tmp_path, toy):
    study = failure_tables.Config(
        circuit="toy", tasks=("ball",), methods=("monte_carlo", "ridge_corner"), seeds=2,
        n_total=60, radius=3.0, probability=False, out=tmp_path,
    )  # fmt: skip
    rows = failure_tables.main(study)["rows"]
    by = {(row["model"], row["metric"]): row for row in rows}
    best = by["ridge + worst corner", "worst_case"]
    assert best["row"] == "margin (ball)" and len(best["values"]) == 2
    # the ball's worst point: 10 - 3 |slope|
    assert np.isclose(best["reachable"], 10 - 3 * np.linalg.norm(SLOPE), atol=0.01)
    assert by["ridge + worst corner", "success_rate"]["mean"] == 1.0
    assert by["ridge + worst corner", "first_failure_hit"]["median"] <= 52
    again = failure_tables.main(study)["rows"]
    assert json.dumps(again, default=str) == json.dumps(rows, default=str)
