"""The list of edits fits the code, and the run tells what tests notice from what they do not."""

from __future__ import annotations

from pathlib import Path

import pytest

from snn_fusion_failure.runs import WorkFailedError, repository
from tests._scripts import load_script

mutate = load_script("tools/mutate")


@pytest.mark.parametrize("mutant", mutate.read_list(), ids=lambda m: m.name[:80])
def test_an_edit_of_the_list_stands_where_it_is_said_to(mutant) -> None:
    text = (repository.ROOT / mutant.file).read_text()
    assert text.count(mutant.old) == 1
    assert mutant.new != mutant.old
    compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    files = [t for t in mutant.tests if t.endswith(".py")]
    assert files and all((repository.ROOT / t).is_file() for t in files)


def test_an_edit_that_does_not_fit_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\nx = 1\n")
    with pytest.raises(ValueError, match=r"expected once in a\.py, found 2"):
        mutate.Mutant("a.py", "x = 1", "x = 2", ("t.py",)).apply(tmp_path)


@pytest.mark.slow
def test_edits_are_noticed_and_one_that_is_not_is_told(monkeypatch) -> None:
    found = mutate.main(mutate.Config(only=("sensor_intervals",)))
    assert found == {"mutants": 4, "noticed": 4, "survivors": 0}
    harmless = mutate.Mutant(
        "jaxsnn/sensor_intervals.py", "# [px]\n_DISTANCE", "# px\n_DISTANCE",
        ("tests/jaxsnn/test_sensor_intervals.py",),
    )  # fmt: skip
    monkeypatch.setattr(mutate, "read_list", lambda: [harmless])
    with pytest.raises(WorkFailedError, match="1 edits are not as in mutants"):
        mutate.main(mutate.Config())
