"""Maps in files and by name: what is read, and what each mistake is told."""

from __future__ import annotations

import json

import numpy as np
import pytest

from jaxsnn import make_map, scenarios
from jaxsnn.map_files import load_map, named_map

GOOD = {
    "target": [400, 300],
    "starts": [[90, 300, 40]],
    "polygons": [[[200, 250], [260, 250], [260, 350], [200, 350]]],
    "circles": [[550, 300, 40]],
    "sonar_stuck": {"1": 20},
}


def write(tmp_path, content):
    path = tmp_path / "my.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return str(path)


def test_a_file_is_what_make_map_makes_of_it(tmp_path):
    read = load_map(write(tmp_path, GOOD))
    made = make_map(**{**GOOD, "sonar_stuck": {1: 20}})
    for a, b in zip(read, made, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "expected JSON"),
        ("[1]", "expected an object with target and starts"),
        ({"target": [1, 2]}, "starts=<missing>: expected it in the file"),
        ({**GOOD, "polygon": []}, "did you mean polygons?"),
        ({**GOOD, "circles": [["a", 2, 3]]}, "circles=.*expected numbers in lists of lists"),
        ({**GOOD, "circles": [[1, 2]]}, "circles"),
        ({**GOOD, "target": [230, 300]}, "unreachable"),
        ({**GOOD, "speed": "fast"}, "speed=fast: expected a number"),
        ({**GOOD, "sonar_stuck": {"left": 2}}, "count sonars from 0"),
    ],
)
def test_each_mistake_is_named_with_the_file(tmp_path, content, words):
    with pytest.raises(ValueError, match=words) as error:
        load_map(write(tmp_path, content))
    assert "my.json" in str(error.value)


def test_names_are_scenarios_detours_families_and_files(tmp_path):
    assert named_map("D2") is scenarios.detour(2) and named_map("S3") is scenarios.scenario(3)
    assert named_map(write(tmp_path, GOOD)).target.tolist() == [400.0, 300.0]
    with pytest.raises(ValueError, match="map=D4: expected S1 to S3, D1 to D3, FAMILY"):
        named_map("D4")
    with pytest.raises(ValueError, match="expected a file to read"):
        named_map(str(tmp_path / "none.json"))
    with pytest.raises(ValueError, match="split='mine'"):
        named_map("maze/mine/0")
