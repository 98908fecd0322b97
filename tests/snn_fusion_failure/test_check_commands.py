"""The run of the documented commands: its table is complete, and a command that fails is seen."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from snn_fusion_failure.documentation import check_commands, documented, executing
from snn_fusion_failure.documentation.command_rules import RULES
from snn_fusion_failure.documentation.documented import Command
from snn_fusion_failure.documentation.rule import Rule
from snn_fusion_failure.runs import repository

COMMANDS = documented.documented()
# Commands that `make commands` does not run: one more has to be argued for, here and in the table.
NOT_RUN = 13


def test_every_command_has_a_rule() -> None:
    assert [c.text for c in COMMANDS if c.rule is None] == []
    assert len(COMMANDS) > 80


def test_few_commands_are_not_run() -> None:
    why = {c.text: c.rule.not_run for c in COMMANDS if c.rule and c.rule.not_run}
    assert len(why) <= NOT_RUN, "\n".join(f"{text}: {reason}" for text, reason in why.items())


def test_every_rule_is_used() -> None:
    used = {c.rule for c in COMMANDS}
    assert [rule.words for rule in RULES if rule not in used] == []


def test_documented_words_stay_and_placeholders_are_filled() -> None:
    for command in COMMANDS:
        if command.rule is None or command.rule.not_run:
            continue
        words = command.words
        assert words[0] == "python" or (repository.ROOT / words[0]).is_file(), command.text
        assert not {"ROOT", "DIR", "KITTI", "RESULTS"} & {p for w in words for p in w.split("/")}
        assert not any(w.startswith(("/", "$")) for w in words)
    text = "taskset -c 0 python scripts/train_detector.py train --data ROOT --steps 9  # why"
    rule = documented.rule_for(text)
    assert rule is not None
    words = Command("page.md", text, rule).words
    assert words[:6] == [
        "scripts/train_detector.py",
        "train",
        "--data",
        "runs/kitti",
        "--steps",
        "9",
    ]
    assert words[6:] == rule.small.split()


def test_the_first_rule_counts() -> None:
    peer = documented.rule_for(
        "python scripts/benchmarks/bench_snn.py --brian2-python PATH/python --record"
    )
    alone = documented.rule_for("python scripts/benchmarks/bench_snn.py")
    assert peer is not None and peer.not_run
    assert alone is not None and not alone.not_run
    assert documented.rule_for("python scripts/of_nobody.py") is None


def test_a_sub_command_of_sff_is_run_as_its_script() -> None:
    """`sff train-argate` in the wheel is `python scripts/train_argate.py` in the repository."""
    (printed,) = documented.commands("```\nsff train-argate --dataset har   # why\n```")
    rule = documented.rule_for(printed)
    assert rule is documented.rule_for("python scripts/train_argate.py --dataset har")
    words = Command("page.md", printed, rule).words
    assert words[:3] == ["scripts/train_argate.py", "--dataset", "har"]


def test_lines_of_other_languages_are_no_commands() -> None:
    blocks = ("python\nmake tea", "\nmake test  # a", "bash\npip install x")
    text = "\nmake do\n".join(f"```{block}\n```" for block in blocks)
    assert documented.shell_lines(text) == ["make test  # a", "pip install x"]


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("import sys; print('result: a=1', sys.argv[1])", ""),
        ("print('no last line')", "the last line is no `result: ...`"),
        ("print('result: a=1'); raise SystemExit(2)", "exit status 2"),
        ("{}['gone']", "KeyError: 'gone'"),
    ],
)
def test_a_command_that_fails_is_seen(tmp_path: Path, code: str, error: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(code, encoding="utf-8")
    held = list(sys.argv)
    assert executing.execute([str(script), "--out"], tmp_path / "log") == error
    assert sys.argv == held
    if not error:
        assert (tmp_path / "log.out").read_text().strip() == "result: a=1 --out"
    if "KeyError" in error:
        assert "Traceback" in (tmp_path / "log.err").read_text()


def test_one_line_of_python_needs_no_result(tmp_path: Path) -> None:
    assert executing.execute(["python", "-c", "print(1)"], tmp_path / "log") == ""
    assert executing.execute(["python", "-c", "1 / 0"], tmp_path / "log").startswith("Zero")


def test_a_process_that_dies_fails_its_commands(tmp_path: Path) -> None:
    """The folder is no copy, so the process gives up before its first command."""
    done = list(executing.run_area(tmp_path, [3, 4]))
    assert [d.number for d in done] == [3, 4]
    assert all("ended with status 1" in d.error for d in done)


def test_a_tool_that_is_not_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        check_commands.missing(Rule("x", needs="no_such_tool")) == "no_such_tool is not installed"
    )
    assert check_commands.missing(Rule("x", needs="numpy")) == ""
    assert check_commands.missing(Rule("x")) == ""
    rule = Rule("compare_snn.py", needs="no_such_tool")
    command = Command("docs/a.md", "python scripts/studies/compare_snn.py", rule)
    monkeypatch.setattr(documented, "documented", lambda: [command])
    chosen, why = check_commands.choose(check_commands.Config())
    assert chosen == {} and list(why) == [0]


def test_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="no documented command"):
        check_commands.choose(check_commands.Config(only=("no such words",)))
    command = Command("docs/a.md", "python scripts/new.py", None)
    monkeypatch.setattr(documented, "documented", lambda: [command])
    with pytest.raises(ValueError, match=r"no rule for 'python scripts/new\.py'"):
        check_commands.choose(check_commands.Config())


def test_quick_commands_run_in_a_copy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """End to end: copy, made-up data, another process, results that stay as they are."""
    before = {p: p.stat().st_mtime_ns for p in repository.RESULTS.iterdir()}
    config = check_commands.Config(only=("compare_snn",), keep=tmp_path / "copy")
    found = check_commands.main(config)
    assert found["executed"] == 1, capsys.readouterr().out
    copied = json.loads((tmp_path / "copy" / "results" / "study_paired_2_3.json").read_text())
    assert copied["command"] == "python scripts/studies/compare_snn.py"
    assert copied["git"] == "unknown"  # which is how one sees that it is the copy's
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_the_parts_are_all_commands_once() -> None:
    parts = [check_commands.choose(check_commands.Config(part=f"{i}/3"))[0] for i in range(3)]
    assert sum(map(len, parts)) == len(check_commands.choose(check_commands.Config())[0])
    assert all(parts)
    with pytest.raises(ValueError, match="part='3/3': expected I/N"):
        check_commands.choose(check_commands.Config(part="3/3"))
