"""The baselines' command: which maps it knows, what PPO gets on detours, and what is recorded."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import learners, scenarios, ways
from snn_fusion_failure.commands import train_rl
from snn_fusion_failure.runs import repository, write_json
from tests._scripts import load_script

SOURCE = {"2.3": {"rows": {"Q-learning": {"sr_testing": 10}}}}


def _values(first: list[float]) -> dict[str, list[float]]:
    scores = {"sr_learning": [50.0] * 2, "sr_testing": [90.0] * 2, "path_ratio": []}
    return scores | {
        "n_mv": [9.0] * 2,
        "trials_to_90": first,
        "share_reaching_90": [100.0] * len(first) + [0.0] * (2 - len(first)),
        "training_trials": [2000.0] * 2,
    }


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of record with the source's table."""
    folder = tmp_path / "results"
    write_json(folder / "source_tables.json", SOURCE)
    monkeypatch.setattr(repository, "RESULTS", folder)
    monkeypatch.setattr(train_rl, "check_recordable", lambda: None)
    return folder


def _rows(path: Path) -> dict[tuple[str, str], Any]:
    return {(r["row"], r["metric"]): r for r in json.loads(path.read_text())["rows"]}


def test_a_map_that_is_none_is_named_with_those_that_are() -> None:
    with pytest.raises(ValueError, match=r"scenarios=\['D4'\]: expected some of 1, 2, 3, D1, D2,"):
        train_rl.main(train_rl.Config(scenarios=("D1", "D4")))


def test_ppo_has_the_sizes_of_the_detour_study_on_detours_alone() -> None:
    config = train_rl.Config(model="ppo")
    assert train_rl.build(config, "D2")["config"] == learners.DETOUR_PPO
    assert train_rl.build(config, "2")["config"].n_envs == 8
    quick = train_rl.build(dataclasses.replace(config, preset="quick"), "D2")["config"]
    assert quick == dataclasses.replace(learners.DETOUR_PPO, n_updates=20)
    changed = dataclasses.replace(config, changes=("config.n_updates=7",))
    assert train_rl.build(changed, "D2")["config"].n_updates == 7


def test_ppo_is_told_of_the_way_on_detours_and_every_map_has_keys_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, Any]] = []

    def spy(sizes: Any, params: Any, map: Any, **named: Any) -> dict[str, list[float]]:
        given.append({"map": map, **named})
        return {}

    monkeypatch.setattr(learners, "train_ppo", spy)
    config = train_rl.Config(model="ppo", seeds=2)
    for name in ("1", "D1"):
        train_rl.train(config, train_rl.build(config, name), name)
    scenario, detour = given
    assert scenario["way"] is None and scenario["map"] is scenarios.scenario(1)
    assert detour["map"] is scenarios.detour(1)
    np.testing.assert_array_equal(
        detour["way"].lengths, ways.way_length(scenarios.detour(1)).lengths
    )
    # Numbers of record of the scenarios depend on their own keys.
    roots = {name: learners.learner_keys(0, number, 2)[1] for name, number in train_rl.MAPS.items()}
    assert (scenario["keys"] == roots["1"]).all() and (detour["keys"] == roots["D1"]).all()
    assert not (roots["1"] == roots["D1"]).any()


@pytest.mark.slow
@pytest.mark.relaxed  # optax mixes int and float in the bias correction of Adam
def test_the_way_is_what_ppo_is_rewarded_by_in_training() -> None:
    sizes = dataclasses.replace(
        learners.DETOUR_PPO, n_envs=2, n_steps=16, n_updates=2, n_minibatches=2, hidden=(4,)
    )
    params, map = learners.DETOUR_PPO_PARAMS, scenarios.detour(1)
    keys, way = learners.learner_keys(0, 11, 2)[1], ways.way_length(map)
    found = learners.train_ppo(sizes, params, map, keys=keys, n_test=1, max_steps=8, way=way)
    assert found["training_trials"] == [8.0, 8.0]  # 2 updates x 2 robots x 16 / 8
    assert found["trials_to_90"] == [] and found["share_reaching_90"] == [0.0, 0.0]
    program = learners._ppo_program(sizes, 1, 8)
    params = jax.tree.map(jnp.float32, params)
    # As `ppo_policies` of the study of detours trains from the same keys.
    train_keys = jax.vmap(lambda key: jax.random.split(key)[0])(keys)
    rewards = []
    for given in (way, None):
        metrics, *_ = program(jax.random.key_data(keys), params, map, given)
        same = learners.ppo_policies(sizes, params, map, given, keys=train_keys, max_steps=8)
        np.testing.assert_allclose(metrics.reward, same.metrics.reward, rtol=1e-5)
        rewards.append(np.asarray(metrics.reward))
    assert (np.abs(rewards[0] - rewards[1]) > 1e-3).all()


def test_a_learner_that_never_gets_to_90_percent_is_left_out_and_told() -> None:
    episodes = np.array([[10, 20, 30, 40], [10, 20, 30, 40]])
    successes = np.array([[0, 5, 15, 24], [0, 5, 10, 20]])
    first = learners._trials_to_90(episodes, successes)
    # The first one: 19 of its latest 20 trials after 40, 15 of 20 after 30.
    np.testing.assert_array_equal(first, [40.0, np.inf])
    assert learners._reaching_90(first) == {
        "trials_to_90": [40.0],
        "share_reaching_90": [100.0, 0.0],
    }


def test_detours_are_recorded_beside_the_scenarios_and_in_no_table_of_the_source(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"1": _values([100.0, 200.0]), "D1": _values([300.0])}
    monkeypatch.setattr(train_rl, "train", lambda config, parts, name: values[name])
    config = train_rl.Config(
        scenarios=("1", "D1"), seeds=2, record=True, out=tmp_path / "run", overwrite=True
    )
    train_rl.main(config)
    rows = _rows(results / "study_rl.json")
    assert rows["Scenario 1", "sr_testing"]["source"] == 10
    assert (
        rows["D1", "trials_to_90"] | {"n": 1, "mean": 300.0, "unit": "trials"}
        == (rows["D1", "trials_to_90"])
    )
    share = rows["D1", "share_reaching_90"]
    assert (share["mean"], share["unit"], share["n"]) == (50.0, "%", 2)
    assert rows["D1", "training_trials"]["mean"] == 2000.0
    assert "source" not in rows["D1", "sr_testing"] and ("D1", "path_ratio") not in rows
    assert {row for row, _ in _rows(results / "table_2_3.json")} == {"Scenario 1"}
    assert sorted(p.name for p in results.glob("table*")) == ["table_2_3.json"]
    # Nobody gets there any more: the mean of those who did goes with its cell.
    values["D1"] = _values([])
    train_rl.main(dataclasses.replace(config, scenarios=("D1",)))
    rows = _rows(results / "study_rl.json")
    assert ("D1", "trials_to_90") not in rows and rows["D1", "share_reaching_90"]["mean"] == 0.0
    assert rows["Scenario 1", "trials_to_90"]["mean"] == 150.0


def test_the_table_of_trials_has_all_maps_and_the_share_that_gets_there(tmp_path: Path) -> None:
    def row(name: str, model: str, metric: str, mean: float, **more: str) -> dict[str, Any]:
        return {"row": name, "model": model, "metric": metric, "mean": mean, **more}

    made = {"command": "python old.py", "git": "abc"}
    snn = [row("trained on D1", "S2 way", "trials_to_90", 11.0)]
    rl = [
        row("D1", "PPO", "trials_to_90", 700.0, command="python new.py", git="def"),
        row("D1", "PPO", "share_reaching_90", 87.5, command="python new.py", git="def"),
        row("D1", "PPO", "sr_testing", 99.0),
    ]
    write_json(tmp_path / "study_snn_trials.json", {**made, "rows": snn})
    write_json(tmp_path / "study_rl.json", {**made, "rows": rl})
    found = load_script("studies/compare_snn").sample_efficiency(tmp_path)
    assert [(r["row"], r["model"], r["metric"], r["command"], r["git"]) for r in found] == [
        ("D1", "S2 way", "trials_to_90", "python old.py", "abc"),
        ("D1", "PPO", "trials_to_90", "python new.py", "def"),
        ("D1", "PPO", "share_reaching_90", "python new.py", "def"),
    ]


@pytest.mark.parametrize("changed", [{"epsilon": 0.0}, {"changes": ("params.discount=0.5",)}])
def test_changed_constants_are_no_row_of_record(changed: dict[str, Any], tmp_path: Path) -> None:
    config = train_rl.Config(seeds=2, record=True, out=tmp_path / "run", **changed)
    with pytest.raises(ValueError, match=r"record=True, set=\['params\..*expected the constants"):
        train_rl.main(config)
