"""The wheel in a fresh environment, away from the repository (CI runs the same as `make wheel`)."""

from __future__ import annotations

import pytest

from tests._scripts import load_script

check_wheel = load_script("tools/check_wheel")


@pytest.mark.slow
def test_the_wheel_works_for_a_user_of_their_own_study() -> None:
    found = check_wheel.main(check_wheel.Config())
    assert found["commands"] >= 7
