"""Which readings and constants let a spiking network learn: variants around a reading, compared.

    python scripts/studies/study_snn.py --study readings --seeds 8 --scenario 2
    python scripts/studies/study_snn.py --study gamma --model S2 --seeds 8 --max-minutes 30
    python scripts/studies/study_snn.py --study way --map detour/validation/0
    python scripts/studies/study_snn.py --study tau_z --reading way --map detour/validation/2
    python scripts/studies/study_snn.py --study critic --map detour/train/0 --unseen 20

Every variant is a reading with a few changes, run over the same seeds on a training scenario or a
validation map; test maps and the seeds of the tables of record are never used. With `--unseen`
robots learn on a map of the split train and are tested on maps of the split validation that they
have not met, one trial of each robot on each. Rows go to `results/study_snn_STUDY.json` as each
variant ends; a variant that is there already (same seeds) is skipped, so a study can be broken off
and gone on with. About 3 CPU-seconds per seed and variant.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated, Any, Literal

from tyro.conf import arg

from snn_fusion_failure.records.rows import record_table, recorded, summarize
from snn_fusion_failure.runs import enable_compilation_cache, repository, run_command
from snn_fusion_failure.runs.networks import changed_preset

TITLE = "Variants of a network around a setting"
# Only the end of a step is rewarded, after the move.
ALONE = ("config.guidance=none", "config.hold_steps=200")
# study -> variant -> (reading, changes)
STUDIES: dict[str, dict[str, tuple[str, tuple[str, ...]]]] = {
    # One reading or option at a time: what the source says with one of ours, ours without one.
    "readings": {
        "literal": ("literal", ()),
        "literal, causal half only": ("literal", ("stdp.anti_causal=0",)),
        "literal, centred eligibility": ("literal", ("params.centring=1", "stdp.anti_causal=0.5")),
        "tuned": ("tuned", ()),
        "tuned, eligibility not centred": ("tuned", ("params.centring=0",)),
        "tuned, reward without a goal angle": ("tuned", ("reward.goal_angle=Infinity",)),
        "tuned, no commitment before a wall": ("tuned", ("reward.commit=0",)),
        "tuned, target rewarded within 200 px only": (
            "tuned",
            ("reward.d_target=200", "reward.r3_base=1"),
        ),
        "tuned, r3 added as printed (base 1)": ("tuned", ("reward.r3_base=1",)),
        "tuned, target rewarded near obstacles, too": (
            "tuned",
            ("reward.target_near_obstacle=1",),
        ),
        "tuned, r3 for one motor only": ("tuned", ("reward.opponent=0",)),
        "tuned, anti-causal half as printed": ("tuned", ("stdp.anti_causal=1",)),
        "tuned, causal half only": ("tuned", ("stdp.anti_causal=0",)),
        "tuned, no homeostasis": ("tuned", ("params.homeostasis=0",)),
        "tuned, angle code by region number": ("tuned", ("config.angle_code=region",)),
        "tuned, angle code as listed": ("tuned", ("config.angle_code=listed",)),
        "tuned, soft bounds": ("tuned", ("config.bounds=soft",)),
    },
    # For maps that need a detour: one part of the reading "way" at a time taken out or changed.
    "way": {
        "way": ("way", ()),
        "way, learning rate not annealed": ("way", ("params.anneal=1e9",)),
        "way, one rate for each sensor": ("way", ("config.input_code=sensor",)),
        "way, no recent turns among the inputs": ("way", ("config.turn_groups=false",)),
        "way, shorter memory of turns": ("way", ("params.goal.memory=0.7",)),
        "way, turns not cut off": ("way", ("params.max_turn=Infinity",)),
        "way, no homeostasis": ("way", ("params.homeostasis=0",)),
        "way, weights held for 50 ms": ("way", ("config.hold_steps=50",)),
        "way, weights held for 50 ms, no homeostasis": (
            "way",
            ("config.hold_steps=50", "params.homeostasis=0"),
        ),
        "way, eligibility not centred": ("way", ("params.centring=0",)),
        "way, no reward at collision and arrival": (
            "way",
            ("reward.collision=0", "reward.arrival=0"),
        ),
        "guided (rule of all sonars)": ("guided", ()),
        "way, rewards by the nearest obstacle": ("way", ("config.guidance=nearest",)),
        "way, rewarded after the move": ("way", ("config.reward_timing=after",)),
        "tuned": ("tuned", ()),
        "literal": ("literal", ()),
    },
    # The reward's end of step by its potential and by a critic's error, beside the trainer's reward
    # and in its place.
    "critic": {
        "way": ("way", ()),
        "way, potential along the way": ("way", ("config.shaping=way",)),
        "way, critic": ("way", ("config.critic=td",)),
        "way, critic and potential": ("way", ("config.critic=td", "config.shaping=way")),
        "way, critic and potential, error to all synapses": (
            "way",
            ("config.critic=td", "config.shaping=way", "config.credit=global"),
        ),
        "potential along the way alone": ("way", (*ALONE, "config.shaping=way")),
        "critic alone": ("way", (*ALONE, "config.critic=td")),
        "critic and potential alone": ("way", (*ALONE, "config.critic=td", "config.shaping=way")),
        "critic and straight potential alone": (
            "way",
            (*ALONE, "config.critic=td", "config.shaping=straight"),
        ),
        "critic and potential alone, error to all synapses": (
            "way",
            (*ALONE, "config.critic=td", "config.shaping=way", "config.credit=global"),
        ),
    },
    # What a network of one map knows of others: more situations in as many trials.
    "unseen": {
        "way": ("way", ()),
        "way, no homeostasis": ("way", ("params.homeostasis=0",)),
        "way, no homeostasis, not annealed": ("way", ("params.homeostasis=0", "params.anneal=1e9")),
        "way, weights held for 50 ms": ("way", ("config.hold_steps=50",)),
        "way, halves tied": ("way", ("config.mirror=true", "params.gamma=6e-4")),
        "way, starts anywhere": ("way", ("config.starts=anywhere",)),
        "way, halves tied, starts anywhere": (
            "way",
            ("config.mirror=true", "params.gamma=6e-4", "config.starts=anywhere"),
        ),
    },
}
# One constant at a time around a reading: study -> what the name says after the reading -> changes.
CONSTANTS: dict[str, dict[str, tuple[str, ...]]] = {
    "gamma": {
        f"gamma {g:g}": (f"params.gamma={g}",) for g in (5e-5, 1.5e-4, 4.5e-4, 1.35e-3, 4e-3)
    },
    "way_gamma": {
        f"gamma {g:g}": (f"params.gamma={g}",) for g in (1.5e-4, 3e-4, 6e-4, 1.2e-3, 2.4e-3, 4.8e-3)
    },
    "goal": {f"goal {g} degrees": (f"reward.goal_angle={g}",) for g in (30, 45, 60, 90)},
    "tau_z": {f"tau_z {t:g} s": (f"stdp.tau_z={t}",) for t in (0.01, 0.025, 0.05, 0.1, 0.3)},
    "homeostasis": {
        f"homeostasis {h:g}/s": (f"params.homeostasis={h}",) for h in (0, 0.001, 0.005, 0.02, 0.05)
    },
    "rates": {
        f"rates {h:g}/{o:g} Hz": (f"params.rate_hidden={h}", f"params.rate_output={o}")
        for h, o in ((10, 40), (25, 40), (25, 60), (25, 100), (50, 60))
    },
    "window": {
        f"control {c} ms, held {h} ms": (f"config.control_steps={c}", f"config.hold_steps={h}")
        for c, h in ((100, 100), (200, 50), (200, 100), (200, 200), (400, 100))
    },
}


@dataclasses.dataclass(frozen=True)
class Study:
    """Compare variants."""

    study: Literal[
        "readings",
        "gamma",
        "goal",
        "tau_z",
        "homeostasis",
        "rates",
        "window",
        "way",
        "way_gamma",
        "critic",
        "unseen",
    ] = "readings"
    reading: Literal["tuned", "way"] = "tuned"
    """Around which reading a constant is changed; `way_gamma` is the rate of "way" alone."""
    model: Annotated[Literal["S1", "S2", "S3", "S4"], arg(aliases=["--network"])] = "S4"
    scenario: Literal[1, 2, 3] = 1
    map: str | None = None
    """A validation map in place of the scenario, FAMILY/validation/NUMBER."""
    seeds: int = 8
    first_seed: int = 1000
    """Not among the seeds of the tables of record (0 to 63)."""
    unseen: int = 0
    """Test on so many maps of the family's validation split instead of on the training map."""
    test_trials: int = 10
    max_steps: int = 200
    block: int = 8
    only: tuple[str, ...] = ()
    """Names of variants; all by default."""
    max_minutes: float = 30.0
    """No variant is begun after so many minutes of CPU time."""


def variants_of(config: Study) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Variant -> (reading, changes) of a study."""
    if config.study in STUDIES:
        return STUDIES[config.study]
    reading = "way" if config.study == "way_gamma" else config.reading
    return {
        f"{reading}, {label}": (reading, changes)
        for label, changes in CONSTANTS[config.study].items()
    }


def _seeds(config: Study) -> list[int]:
    return list(range(config.first_seed, config.first_seed + config.seeds))


def _on_its_map(
    config: Study, run: Any, params: Any
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Scores of each robot on the map that it has learnt on, and the mean rates in testing [Hz]."""
    from jaxsnn import scores

    records = scores.per_seed(run(_seeds(config), params), _seeds(config))
    rates = [sum(r["testing"]["rates"][k] for r in records) / len(records) for k in range(3)]
    return scores.score(records), {"rates_testing": rates}


def _on_unseen_maps(
    config: Study, network: Any, params: Any, map: Any
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Scores of each robot on maps that it has not met, one trial on each."""
    from snn_fusion_failure.records.detour_rows import FAMILY, tested_maps
    from snn_fusion_failure.records.detour_runs import drive_tests, frozen_phase, learn_on

    states = learn_on(
        network, params, map, _seeds(config), max_steps=config.max_steps, block=config.block
    )
    maps = tested_maps(FAMILY, config.unseen, "validation")
    phase = frozen_phase(network, params, states, max_steps=config.max_steps)
    return drive_tests(maps, 1, _seeds(config), phase), {}


def main(config: Study) -> dict[str, Any]:
    """Run the variants that are missing; returns SR-testing by variant."""
    from jaxsnn import scenarios
    from jaxsnn.experiment import learning_circles, make_runner
    from jaxsnn.map_files import named_map
    from jaxsnn.ways import training_map

    if config.map is not None and config.map.split("/")[1:2] == ["test"]:
        raise ValueError(f"map={config.map!r}: expected a map of the split validation or train")
    if config.unseen and (config.map or "").split("/")[1:2] != ["train"]:
        raise ValueError(f"map={config.map!r}: expected a map of the split train with --unseen")
    variants = variants_of(config)
    map = scenarios.scenario(config.scenario) if config.map is None else named_map(config.map)
    unknown = set(config.only) - set(variants)
    if unknown:
        raise ValueError(f"only={sorted(unknown)}: expected some of {sorted(variants)}; choose")
    enable_compilation_cache()
    path = repository.RESULTS / f"study_snn_{config.study}.json"
    held = {
        (r["row"], r["model"])
        for r in recorded(path)
        if r["metric"] == "sr_testing" and r["n"] >= config.seeds
    }
    model = f"{config.model} {config.map or f'scenario {config.scenario}'}"
    model += f", {config.unseen} unseen maps" if config.unseen else ""
    circles = None if config.map else learning_circles(config.scenario, 20)
    done: dict[str, float] = {}
    runners: dict[Any, Any] = {}
    start = time.process_time()
    for name, (reading, changes) in variants.items():
        if (config.only and name not in config.only) or (name, model) in held:
            continue
        if time.process_time() - start > 60 * config.max_minutes:
            break
        built, params = changed_preset(config.model, reading, changes)
        if config.unseen:
            values, rates = _on_unseen_maps(config, built, params, map)
        else:
            if built not in runners:
                runners[built] = make_runner(
                    built, training_map(built, map), n_learn=20, n_test=config.test_trials,
                    test_map=map, max_steps=config.max_steps, block=config.block,
                    circles=circles if built.starts == "circles" else None,
                )  # fmt: skip
            values, rates = _on_its_map(config, runners[built], params)
        summary = {k: summarize(v) for k, v in values.items() if v}
        rows = [
            {"row": name, "model": model, "metric": metric, "setting": reading,
             "changes": list(changes), **values}
            for metric, values in summary.items()
        ]  # fmt: skip
        rows[0] |= rates
        preset = f"{config.seeds} seeds, {config.test_trials} testing trials"
        record_table(path, path.stem, TITLE, rows, preset=preset)
        done[name] = summary["sr_testing"]["mean"]
        print(name, {m: round(v["mean"], 1) for m, v in summary.items()}, flush=True)
    return done


def fields(done: dict[str, float]) -> dict[str, Any]:
    """What the result line says."""
    best = max(done, key=lambda name: done[name]) if done else "none"
    return {"variants": len(done), "best": best.replace(" ", "_")}


if __name__ == "__main__":
    run_command(Study, main, description=__doc__, fields=fields)
