"""Netlists as simulators: what is refused, what is read, what a missing measure means."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from failure.identities import identity_of
from failure.simulators import SimulatorError, netlist_simulator
from failure.simulators.corners import Corner, pvt_corners
from failure.simulators.deck import parse_deck, read_deck
from failure.simulators.measures import parse_limit, violation
from failure.simulators.netlist_simulator import NetlistSimulator
from failure.simulators.spice import parse_number, printed_numbers
from failure.simulators.variation import parse_variation
from failure.status import Status

NETLIST = """a divider
.param r1=1k r2=1k unused=3 ; a comment with r9=2
.param vin={2*r0}
+ r0=1
* .param r8=1
v1 a 0 {vin}
ra a b {r1}
rb b 0 {r2}
.end
"""

PROGRAM = """
import re, sys, pathlib
text = pathlib.Path(sys.argv[1]).read_text()
log = pathlib.Path(sys.argv[2])
log.write_text(log.read_text() + "run\\n")
value = {k: float(v) for k, v in re.findall(r"(r\\d)=([-+.e\\d]+)", text)}
temp = re.search(r"^\\.temp (\\S+)", text, re.M)
out = value["r2"] / (value["r1"] + value["r2"]) * (1 + (float(temp[1]) if temp else 0.0) / 1000)
if value["r1"] > 1200:
    print("Error: time step too small")
elif value["r1"] > 1100:
    print("OUT = 0.5\\nother = failed")
else:
    print(f"OUT = {out:.9e} at= 1.0\\nother = 1.0")
"""


@pytest.fixture
def command(tmp_path: Path) -> tuple[str, Path]:
    program, log = tmp_path / "divider.py", tmp_path / "log"
    program.write_text(PROGRAM)
    log.write_text("")
    return f"{sys.executable} -I -S {program} {{deck}} {log}", log


def simulator(command: str, **options) -> NetlistSimulator:
    limits = [parse_limit(t) for t in options.pop("limits", ["out<=0.6", "other>=0.5"])]
    return NetlistSimulator(
        parse_deck("divider\n.param r1=1k r2=1000\nra a b {r1}\nrb b 0 {r2}\n.end"),
        parse_variation(["r1:1%", "r2:10"]),
        limits,
        command=command,
        **options,
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [("20u", 2e-5), ("4.7K", 4.7e3), ("1meg", 1e6), ("2mil", 50.8e-6), ("-3.5e-3V", -3.5e-3)],
)
def test_spice_numbers(text: str, value: float) -> None:
    assert parse_number(text) == pytest.approx(value, rel=1e-12)


def test_numbers_are_read_from_an_output() -> None:
    text = "t1 =  5.2e-10\nFREQ = 4e9 targ= 1 trig= 2\nfreq2=   failed\nv(out) = inf\n a = b\n"
    assert printed_numbers(text) == {"t1": 5.2e-10, "freq": 4e9, "v(out)": np.inf}


def test_parameters_of_a_netlist() -> None:
    deck = parse_deck(NETLIST)
    assert dict(deck.parameters) == {
        "r1": "1k", "r2": "1k", "unused": "3", "vin": "{2*r0}", "r0": "1",
    }  # fmt: skip
    assert deck.used == {"r1", "r2", "vin", "r0"}
    text = deck.render({"r1": 1234.5, "r0": 0.25}, temperature=85.0)
    assert ".param r1=1234.5 r2=1k" in text and "+ r0=0.25" in text and "\n.temp 85\n" in text
    assert "* .param r8=1" in text


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["r7"], r"vary='r7': expected a \.param of the netlist \(r1, r2"),
        (["unused"], r"vary='unused': .*nothing refers to it"),
    ],
)
def test_unknown_and_unused_parameters_are_refused(names: list[str], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        parse_deck(NETLIST).check(names, what="vary")


def test_an_expression_cannot_vary_and_a_double_definition_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'vin' is set to .*expected a number"):
        parse_deck(NETLIST).value("vin")
    with pytest.raises(ValueError, match="'r1' is defined twice"):
        parse_deck("t\n.param r1=1 r1=2\n")


def test_included_files_are_found_counted_and_belong_to_the_identity(tmp_path: Path) -> None:
    (tmp_path / "models.inc").write_text(".model nm nmos vto={vt}\n")
    netlist = tmp_path / "a.cir"
    netlist.write_text("t\n.param vt=0.5\n.include models.inc\n.end\n")
    deck = read_deck(netlist)
    assert deck.used == {"vt"} and f'"{tmp_path}/models.inc"' in deck.text
    (tmp_path / "models.inc").write_text(".model nm nmos vto={vt} kp=1\n")
    assert read_deck(netlist).digest != deck.digest
    netlist.write_text("t\n.include nothing.inc\n")
    with pytest.raises(FileNotFoundError, match=r"nothing\.inc"):
        read_deck(netlist)


def test_sections_of_a_library_are_corners(tmp_path: Path) -> None:
    (tmp_path / "models.lib").write_text(".lib tt\n.endl\n.lib ss\n.endl\n")
    netlist = tmp_path / "a.cir"
    netlist.write_text('t\n.lib "models.lib" tt\n.end\n')
    assert f'.lib "{tmp_path}/models.lib" ss\n' in read_deck(netlist).render({}, section="ss")


def test_limits_and_violations() -> None:
    limits = [parse_limit(t) for t in ("tset <= 20u", "gain>=60", "-5 <= offset <= 10")]
    assert [limit.text for limit in limits] == ["tset<=2e-05", "gain>=60", "-5<=offset<=10"]
    nominal = np.array([10e-6, 80.0, 0.0])
    values = np.array([nominal, [20e-6, 50.0, -7.5], [40e-6, np.nan, 12.0]])
    np.testing.assert_allclose(
        violation(limits, nominal, values), [[-1, -1, -1], [0, 0.5, 0.5], [2, np.nan, 0.2]]
    )
    for text in ("gain", "gain=60", "5<=gain<=2", "gain<=big", "<=5"):
        with pytest.raises(ValueError, match="expected"):
            parse_limit(text)
    with pytest.raises(ValueError, match=r"a nominal circuit that passes; it has gain = 5"):
        violation([parse_limit("gain>=60")], np.array([50.0]), values[:, 1:2])


def test_sigma_becomes_physical_and_back() -> None:
    variation = parse_variation(["a:2m", "b:1%", "c:3"], ["a,b:0.6"])
    nominal = np.array([0.0, 200.0, 5.0])
    x = np.random.default_rng(0).normal(size=(20000, 3))
    values = variation.physical(x, nominal)
    np.testing.assert_allclose(values.std(axis=0), [2e-3, 2.0, 3.0], rtol=0.03)
    assert np.corrcoef(values.T)[0, 1] == pytest.approx(0.6, abs=0.02)
    assert abs(np.corrcoef(values.T)[0, 2]) < 0.03
    np.testing.assert_allclose(variation.standard(values, nominal), x, atol=1e-9)


def test_a_correlation_matrix_is_read_by_name(tmp_path: Path) -> None:
    file = tmp_path / "c.csv"
    file.write_text("b,a\n1,0.3\n0.3,1\n")
    variation = parse_variation(["a:1", "c:1", "b:1"], [str(file)])
    np.testing.assert_array_equal(variation.correlation, [[1, 0, 0.3], [0, 1, 0], [0.3, 0, 1]])


@pytest.mark.parametrize(
    "content",
    [b"", b"\n", b"b,a\n", b"b,a\n1,0.3\n", b"a,\xe9\n1,0\n0,1\n", b"a,b\n1,x\n0,1\n", b"a\x00"],
    ids=repr,
)
def test_a_correlation_file_that_is_none_is_named(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "c.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"correlate='.*c\.csv': expected a line of names"):
        parse_variation(["a:1", "b:1"], [str(file)])
    with pytest.raises(FileNotFoundError, match=r"correlate='.*d\.csv': expected a file"):
        parse_variation(["a:1", "b:1"], [str(tmp_path / "d.csv")])


@pytest.mark.parametrize(
    ("vary", "correlate", "wanted"),
    [
        (["a"], [], "vary='a': expected NAME:SIGMA"),
        (["a:0"], [], "expected NAME:SIGMA with SIGMA above 0"),
        (["a:1", "A:2"], [], "vary='a': expected once"),
        (["a:1", "b:1"], ["a,d:0.5"], r"expected names of vary \(a, b\)"),
        (["a:1", "b:1"], ["a,b:1.0"], "RHO between -1 and 1"),
        (["a:1", "b:1", "c:1"], ["a,b:0.9", "b,c:0.9", "a,c:-0.9"], "positive definite"),
    ],
)
def test_bad_variations_are_named(vary: list[str], correlate: list[str], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        parse_variation(vary, correlate)


def test_a_relative_sigma_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="vary='a': expected an absolute sigma"):
        parse_variation(["a:1%"]).physical(np.zeros((1, 1)), np.zeros(1))


def test_corners_multiply() -> None:
    corners = pvt_corners(["tt", "ss:vtn=0.5,lib=slow"], ["temp=-40,125", "vdd=1.6"])
    assert [c.name for c in corners] == [
        "tt temp=-40 vdd=1.6", "tt temp=125 vdd=1.6", "ss temp=-40 vdd=1.6", "ss temp=125 vdd=1.6",
    ]  # fmt: skip
    assert corners[3] == Corner(corners[3].name, (("vtn", 0.5), ("vdd", 1.6)), 125.0, "slow")
    for corners_given, lists in ((["a:b"], []), (["a", "a"], []), ([], ["vdd"])):
        with pytest.raises(ValueError, match="expected"):
            pvt_corners(corners_given, lists)


def test_measures_in_corners_worst_over_them(command) -> None:
    corners = (Corner("cold", (), -40.0), Corner("hot", (("r2", 1100.0),), 125.0))
    simulate = simulator(command[0], corners=corners, workers=2, limits=["out<=0.9"])
    x = np.array([[0.0, 0.0], [-3.0, 1.0]])
    values, status = simulate.measure(x)
    r1, r2 = 970.0, np.array([1010.0, 1110.0])
    np.testing.assert_allclose(values[1, :, 0], r2 / (r1 + r2) * [0.96, 1.125], rtol=1e-8)
    g, status = simulate(x)
    cold, hot = simulate.nominal[:, 0]
    np.testing.assert_allclose(g[0], -1.0)
    np.testing.assert_allclose(g[1, 0], (values[1, 1, 0] - 0.9) / (0.9 - hot), rtol=1e-12)
    assert status.tolist() == [Status.GOOD] * 2 and cold < hot


def test_a_missing_measure_is_what_it_was_said_to_be(command, tmp_path: Path) -> None:
    x = np.array([[0.0, 0.0], [15.0, 0.0], [25.0, 0.0]])
    g, status = simulator(command[0], keep=tmp_path / "kept")(x)
    assert status.tolist() == [0, 0, 0]
    np.testing.assert_allclose(g, [[-1, -1], [-1, 1], [1, 1]], atol=1e-9)
    logs = sorted((tmp_path / "kept").glob("odd_*.log"))
    assert len(logs) == 2 and any("time step too small" in p.read_text() for p in logs)
    assert all(p.with_suffix(".cir").read_text().startswith("divider\n") for p in logs)

    ignoring = simulator(command[0], invalid="ignore")
    g, status = ignoring(x)
    assert status.tolist() == [Status.GOOD, Status.NOT_FINITE, Status.FAILED]
    assert np.isnan(g[1, 1]) and not np.isnan(g[1, 0]) and np.isnan(g[2]).all()
    assert "no number for other; printed: out" in ignoring.messages[1, "nominal"]
    with pytest.raises(SimulatorError, match="sample 1, corner nominal: no number for other"):
        simulator(command[0], invalid="stop")(x)


def test_failing_runs_are_kept_and_leave_room_for_odd_ones(
    command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Out is 1000 / (r1 + 1000): beyond 0.6 below r1 = 667, missing above r1 = 1200."""
    monkeypatch.setattr(netlist_simulator, "_KEPT", 2)
    x = np.array([[0.0, 0.0], [-35.0, 0.0], [-40.0, 0.0], [-45.0, 0.0], [25.0, 0.0], [-30.0, 0.0]])
    g, _ = simulator(command[0], keep=tmp_path / "kept")(x)
    assert (g[:, 0] > 0).tolist() == [False, True, True, True, True, False]
    decks = {label: sorted((tmp_path / "kept").glob(f"{label}_*.cir")) for label in ("fail", "odd")}
    assert [len(found) for found in decks.values()] == [2, 1]
    assert [".param r1=650" in p.read_text() or ".param r1=600" in p.read_text()
            for p in decks["fail"]] == [True, True]  # fmt: skip
    assert all("OUT = 6." in p.with_suffix(".log").read_text() for p in decks["fail"])


def test_an_infinite_measure_is_kept_as_odd(tmp_path: Path) -> None:
    text = f"{sys.executable} -I -S -c 'print(\"out = 0.5\\nother = inf\")' {{deck}}"
    simulate = simulator(text, keep=tmp_path / "kept", invalid="ignore")
    values, _ = simulate.measure(np.zeros((1, 2)))
    assert values[0, 0].tolist() == [0.5, np.inf]
    assert [p.name[:4] for p in (tmp_path / "kept").glob("*.cir")] == ["odd_"]


def test_measures_are_read_from_a_file_beside_the_deck(tmp_path: Path) -> None:
    """Xyce prints them to `deck.cir.mt0`, and to the screen under headings only."""
    program = tmp_path / "xyce.py"
    program.write_text(
        "import re, sys\n"
        "r1, r2 = re.findall(r'r\\d=([-+.e\\d]+)', open(sys.argv[1]).read())\n"
        "out = float(r2) / (float(r1) + float(r2))\n"
        "open(sys.argv[1] + '.mt0', 'w').write(f'OUT = {out:.9e}\\nOTHER = 1.0\\n')\n"
        "print('***** Beginning Transient Analysis')\n"
    )
    simulate = simulator(f"{sys.executable} -I -S {program} {{deck}}")
    values, status = simulate.measure(np.array([[-10.0, 0.0], [0.0, 10.0]]))
    np.testing.assert_allclose(values[:, 0], [[1000 / 1900, 1.0], [1100 / 2100, 1.0]], rtol=1e-8)
    assert status.tolist() == [[Status.GOOD], [Status.GOOD]]


def test_runs_are_paid_for_once_whatever_the_limits(command, tmp_path: Path) -> None:
    text, log = command
    x = np.array([[0.0, 0.0], [1.0, 2.0]])
    first = simulator(text, cache=tmp_path / "cache")
    g, _ = first(x)
    assert log.read_text().count("run") == first.simulations == 2
    other = simulator(text, cache=tmp_path / "cache", limits=["out<=0.7"])
    g2, _ = other(x)
    assert log.read_text().count("run") == 2 and other.simulations == 0
    assert g2[1, 0] < g[1, 0]
    for path in (tmp_path / "cache").rglob("*.json"):
        path.write_bytes(b"\xff")
    again, _ = simulator(text, cache=tmp_path / "cache")(x)
    np.testing.assert_array_equal(again, g)
    assert len(list((tmp_path / "cache").rglob("*.broken"))) == 2


def test_a_simulator_that_never_works_stops_at_once_with_its_message(command) -> None:
    dead = simulator(f"{sys.executable} -c 'import sys; sys.exit(\"no licence\")' {{deck}}")
    with pytest.raises(SimulatorError, match=r"nominal circuit.*printed: nothing.*no licence"):
        dead(np.zeros((50, 2)))
    assert dead.simulations == 1
    with pytest.raises(SimulatorError, match=r"command='no-such-spice': expected a program"):
        simulator("no-such-spice {deck}")
    with pytest.raises(ValueError, match=r"expected \{deck\}"):
        simulator("ngspice")
    with pytest.raises(ValueError, match="invalid='skip': expected one of fail"):
        simulator(command[0], invalid="skip")


def test_netlists_are_told_apart_by_all_that_their_answers_depend_on(command) -> None:
    text = command[0]
    same = simulator(text)
    others = [
        simulator(f"{text} "),
        simulator(text, limits=["out<=0.7", "other>=0.5"]),
        simulator(text, corners=(Corner("hot", (), 125.0),)),
        simulator(text, invalid="ignore"),
        dataclasses.replace(same, deck=dataclasses.replace(same.deck, text=same.deck.text + "\n*")),
        dataclasses.replace(same, deck=dataclasses.replace(same.deck, digest="another include")),
        dataclasses.replace(same, variation=parse_variation(["r1:2%", "r2:10"])),
        dataclasses.replace(same, variation=parse_variation(["r1:1%", "r2:10"], ["r1,r2:0.5"])),
    ]
    names = [identity_of(one) for one in (same, *others)]
    assert len(set(names)) == len(names) and all(names)
    cheaper = simulator(text, workers=2, timeout=9.0, retries=3, cache=Path("c"), keep=Path("k"))
    assert identity_of(cheaper) == names[0]
    assert identity_of(same.__call__) != identity_of(others[1].__call__)


@pytest.mark.parametrize(
    "record", ["{}", "[]", '{"numbers": 3, "trouble": ""}', '{"numbers": {"out": "x"}}']
)
def test_a_record_of_a_run_without_its_numbers_is_simulated_again(
    command, tmp_path: Path, record: str
) -> None:
    text, log = command
    x = np.zeros((1, 2))
    g, _ = simulator(text, cache=tmp_path / "cache")(x)
    (path,) = (tmp_path / "cache").rglob("*.json")
    path.write_text(record)
    again, _ = simulator(text, cache=tmp_path / "cache")(x)
    np.testing.assert_array_equal(again, g)
    assert log.read_text().count("run") == 2 and path.with_suffix(".broken").exists()


def test_shapes_are_checked(command) -> None:
    with pytest.raises(ValueError, match=r"x of shape \(1, 3\): expected \[n, 2\]"):
        simulator(command[0])(np.zeros((1, 3)))


def test_a_run_that_hangs_is_ended(tmp_path: Path) -> None:
    simulate = simulator("sh -c 'sleep 300' {deck}", timeout=0.3, keep=tmp_path)
    with pytest.raises(SimulatorError, match=r"no result after 0\.3 s"):
        simulate(np.zeros((1, 2)))
