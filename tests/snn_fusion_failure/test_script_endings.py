"""Every script ends alike: 2 for bad input, 1 for failed work, 130 after Ctrl-C, `result:` last."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests._scripts import SCRIPTS, load_script

FILES = sorted(
    str(path.relative_to(SCRIPTS).with_suffix(""))
    for path in SCRIPTS.rglob("*.py")
    if "__main__" in path.read_text(encoding="utf-8")
)
ENDINGS = {"run_command", "cli"}
"""What a script may hand its work to; `cli` of a command calls `run_command` itself."""


def faults(tree: ast.Module) -> list[str]:
    """Ways of ending that are not those of the house."""
    imported = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    found = ["calls tyro itself"] if "tyro" in imported else []
    block = next(
        n for n in tree.body if isinstance(n, ast.If) and "__main__" in ast.unparse(n.test)
    )
    calls = {
        ast.unparse(node.func).split(".")[-1]
        for node in ast.walk(block)
        if isinstance(node, ast.Call)
    }
    if not calls & ENDINGS:
        found.append(f"ends by {sorted(calls)}")
    if any(isinstance(node, ast.Try) for node in ast.walk(block)):
        found.append("catches errors itself")
    return found


@pytest.mark.parametrize("name", FILES)
def test_a_script_hands_its_ending_to_run_command(name: str) -> None:
    text = (SCRIPTS / f"{name}.py").read_text(encoding="utf-8")
    assert faults(ast.parse(text)) == []


@pytest.mark.parametrize(
    ("code", "good"),
    [
        ("if __name__ == '__main__':\n    run_command(Config, main, description=__doc__)", True),
        ("if __name__ == '__main__':\n    train_snn.cli()", True),
        ("import tyro\nif __name__ == '__main__':\n    main(tyro.cli(Config))", False),
        ("if __name__ == '__main__':\n    main(Config())", False),
        (
            "if __name__ == '__main__':\n    try:\n        run_command(Config, main)\n"
            "    except ValueError:\n        pass",
            False,
        ),
    ],
)
def test_the_rule_itself(code: str, good: bool) -> None:
    assert (faults(ast.parse(code)) == []) is good


@pytest.mark.parametrize(
    ("script", "options", "text"),
    [
        ("studies/study_geometry", [], "expected --real or --simulated"),
        ("benchmarks/device", ["--parts", "sailing"], "parts=sailing: expected some of"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    script: str, options: list[str], text: str, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / f"{script}.py"), *options],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(SCRIPTS.parent), "PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu"},
    )
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: ") and text in line


def test_ctrl_c_in_a_study_is_status_130(capsys: pytest.CaptureFixture[str]) -> None:
    study = load_script("studies/study_parity")

    def stopped(config: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as caught:
        study.run_command(study.Config, stopped, description=None, fields=study.summary, argv=[])
    assert caught.value.code == 130
    assert capsys.readouterr().err.startswith("interrupted: ")
