import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from failure import circuits
from failure.circuits import Circuit, Spec
from snn_fusion_failure.commands import find_failures
from snn_fusion_failure.records import failure_tables

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
    with pytest.raises(ValueError, match="n_total: 12 -> 13"):
        find_failures.main(dataclasses.replace(config, n_total=13, resume=True))
    again = find_failures.main(dataclasses.replace(config, resume=True))
    other = find_failures.main(dataclasses.replace(config, seeds=1, overwrite=True))
    assert len(again["worst_case"]) == 2 and len(other["worst_case"]) == 1


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
