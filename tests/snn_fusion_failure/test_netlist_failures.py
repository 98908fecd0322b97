"""`find-failures --netlist`: from a netlist to worst cases, yield, report and decks."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from scipy.stats import norm

from snn_fusion_failure.commands import find_failures, netlist_failures
from snn_fusion_failure.commands.netlist_failures import NetlistConfig
from snn_fusion_failure.runs import WorkFailedError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
needs_ngspice = pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="ngspice is not installed"
)

PROGRAM = """
import re, sys, pathlib
text = pathlib.Path(sys.argv[1]).read_text()
v = {k: float(x) for k, x in re.findall(r"(\\w+)=([-+.e\\d]+)", text)}
print(f"out = {v['a'] + 2 * v['b'] / 100 + v['shift']:.9e}")
"""
BETA = 4.0 / 5**0.5
"""out is N(0, 5 sigma^2) for the sigmas below, and must stay below 4 sigma."""


@pytest.fixture
def config(tmp_path: Path) -> NetlistConfig:
    program, netlist = tmp_path / "program.py", tmp_path / "sum.cir"
    program.write_text(PROGRAM)
    netlist.write_text("sum\n.param a=0 b=100 shift=-2\nra 1 {a} {b} {shift}\n.end\n")
    return NetlistConfig(
        netlist,
        ("a:1", "b:100%"),
        ("out<=4", "-30<=out<=30"),
        command=f"{sys.executable} -I -S {program} {{deck}}",
        n_total=60,
        out=tmp_path / "run",
    )


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_worst_cases_yield_and_files(config: NetlistConfig, capsys) -> None:
    result = netlist_failures.main(config)
    first, low, high = result["specs"]
    assert [s["spec"] for s in result["specs"]] == ["out<=4", "out>=-30", "out<=30"]
    assert first["distance"] == pytest.approx(BETA, abs=0.01)
    assert first["probability"] == pytest.approx(norm.sf(BETA), rel=0.02)
    assert first["shares"] == pytest.approx({"a": 0.2, "b": 0.8}, abs=0.01)
    assert first["worst"]["b"] == pytest.approx(100 + 100 * BETA * 0.8**0.5, rel=0.02)
    assert low["distance"] is None and "no failing sample" in high["verdict"]
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("out<=4 ") and "1.79 sigma" in out[0]
    assert out[-1].startswith("result: worst_distance=1.78")
    ranked = read(config.out / "parameters.csv")
    assert [r["parameter"] for r in ranked[:2]] == ["b", "a"]
    assert float(read(config.out / "specs.csv")[0]["dppm"]) == pytest.approx(
        1e6 * norm.sf(BETA), rel=0.02
    )
    deck = config.out / first["deck"]
    done = subprocess.run(
        [*config.command.split()[:-1], str(deck)], capture_output=True, text=True, check=True
    )
    assert float(done.stdout.split("=")[1]) > 4.0
    page = (config.out / "report.html").read_text()
    assert "out&lt;=4" in page and "DPPM" in page and first["deck"] in page
    json.loads((config.out / "result.json").read_text())
    samples = read(config.out / "samples.csv")
    assert len(samples) == 60 and {"a", "b", "out", "what_for"} <= set(samples[0])


@pytest.mark.slow
def test_a_larger_budget_and_earlier_samples_pay_for_nothing_twice(config: NetlistConfig) -> None:
    first = netlist_failures.main(config)
    with pytest.raises(ValueError, match="already holds a run; pass --resume"):
        netlist_failures.main(config)
    again = netlist_failures.main(dataclasses.replace(config, resume=True))
    assert again["started"] == 0 and repr(again["specs"]) == repr(first["specs"])
    larger = netlist_failures.main(dataclasses.replace(config, resume=True, n_total=100))
    assert 0 < larger["started"] < 100
    with pytest.raises(ValueError, match=r"other settings \(measure: "):
        netlist_failures.main(dataclasses.replace(config, resume=True, measure=("out<=5",)))
    start = dataclasses.replace(
        config, start=config.out / "samples.csv", out=config.out / "other", n_total=20
    )
    found = netlist_failures.main(start)
    assert BETA - 0.01 < found["specs"][0]["distance"] < 1.1 * BETA
    assert found["started"] <= 24
    bad = config.out / "bad.csv"
    bad.write_text("a,b\n1,x\n")
    with pytest.raises(ValueError, match=r"bad\.csv', line 2: could not convert"):
        netlist_failures.main(dataclasses.replace(start, start=bad, overwrite=True))


@pytest.mark.slow
def test_corners_count_with_their_worst(config: NetlistConfig) -> None:
    corners = ("tt", "off:shift=0")
    result = netlist_failures.main(dataclasses.replace(config, corners=corners))
    assert result["specs"][0]["corner"] == "off"
    assert result["specs"][0]["distance"] == pytest.approx(2.0 / 5**0.5, abs=0.01)
    assert [float(r["out"]) for r in read(config.out / "corners.csv")] == [0.0, 2.0]


def test_what_cannot_work_is_said_at_once(config: NetlistConfig, capsys) -> None:
    broken = dataclasses.replace(config, command="sh -c 'echo Error: no licence' {deck}")
    with pytest.raises(WorkFailedError, match=r"nominal circuit.*no licence"):
        netlist_failures.main(broken)
    words = ["--netlist", str(config.netlist), "--vary", "c:1", "--measure", "out<=4"]
    with pytest.raises(SystemExit) as left:
        find_failures.cli([*words, "--command", config.command, "--out", str(config.out / "x")])
    assert left.value.code == 2
    assert "vary='c': expected a .param of the netlist (a, b, shift)" in capsys.readouterr().err


@needs_ngspice
@pytest.mark.parametrize(
    ("name", "vary", "measure", "nominal"),
    [
        ("opamp", ("dvt1:2m", "dvt2:2m", "rl:1%"), ("tset<=8n", "gain>=60"), (6.24e-9, 79.35)),
        ("ring_oscillator", ("n1:10m", "p1:10m"), ("freq>=5g", "current<=1m"), (6.53e9, 4.16e-4)),
        (
            "sram_cell",
            ("pd1:20m", "ax1:20m", "pd2:20m"),
            ("snm1>=130", "snm2>=130"),
            (211.5, 211.5),
        ),
    ],
)
def test_examples_run(name, vary, measure, nominal, tmp_path: Path) -> None:
    config = NetlistConfig(EXAMPLES / f"{name}.cir", vary, measure, n_total=60, out=tmp_path)
    result = netlist_failures.main(config)
    assert [s["nominal"] for s in result["specs"]] == pytest.approx(list(nominal), rel=2e-3)
    assert result["simulations"] == 60
