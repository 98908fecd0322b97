"""How the documented commands of the spiking robots are run."""

from __future__ import annotations

from snn_fusion_failure.documentation.rule import Rule

_ROBOT = "--seeds 1 --max-steps 3"
_LEARNER = "--seeds 1 --test-trials 1 --max-steps 5 --overwrite"

ROBOTS = (
    Rule("train_snn.py", f"{_ROBOT} --preset quick --overwrite"),
    Rule("study_transfer.py", f"{_ROBOT} --maps 1 --test-trials 1 --scenarios 1 --checkpoints 20"),
    Rule(
        "study_detour.py",
        f"{_ROBOT} --models blind --rows D1 --test-trials 1",
        forget="results/study_detour.json",
    ),
    Rule(
        "study_guidance.py",
        "--samples 2 --maps 1 --test-maps 1 --robots 1 --trials 1",
        forget="results/study_guidance.json",
    ),
    Rule(
        "study_families.py",
        "--families open --axes '4 robots in one world' --named D1 --maps 1 --robots 1 --trials 1",
        forget="results/study_families.json",
    ),
    Rule(
        "study_lifelong.py",
        f"{_ROBOT} --models blind --rows 'weak motor' --trials 1",
        forget="results/study_lifelong.json",
    ),
    Rule(
        "study_snn.py critic --unseen",
        f"{_ROBOT} --unseen 1 --only 'critic and potential alone'",
        forget="results/study_snn_critic.json",
    ),
    Rule(
        "study_snn.py critic",
        f"{_ROBOT} --test-trials 1 --only 'critic and potential alone'",
        forget="results/study_snn_critic.json",
    ),
    Rule(
        "study_snn.py unseen",
        f"{_ROBOT} --unseen 1 --only 'way, halves tied'",
        forget="results/study_snn_unseen.json",
    ),
    *(
        Rule(
            f"study_snn.py {study} way",
            f"{_ROBOT} --test-trials 1 --only 'way, {only}'",
            forget=f"results/study_snn_{study}.json",
        )
        for study, only in (
            ("tau_z", "tau_z 0.1 s"),
            ("homeostasis", "homeostasis 0.02/s"),
            ("rates", "rates 25/40 Hz"),
            ("window", "control 400 ms, held 100 ms"),
        )
    ),
    Rule(
        "study_snn.py goal",
        f"{_ROBOT} --test-trials 1 --only 'tuned, goal 45 degrees'",
        forget="results/study_snn_goal.json",
    ),
    Rule("study_snn.py gamma", f"{_ROBOT} --test-trials 1", forget="results/study_snn_gamma.json"),
    Rule(
        "study_snn.py readings",
        f"{_ROBOT} --test-trials 1 --only tuned",
        forget="results/study_snn_readings.json",
    ),
    Rule(
        "study_snn.py way",
        f"{_ROBOT} --test-trials 1 --only tuned",
        forget="results/study_snn_way.json",
    ),
    Rule(
        "study_snn.py way_gamma",
        f"{_ROBOT} --test-trials 1 --only 'way, gamma 0.0003'",
        forget="results/study_snn_way_gamma.json",
    ),
    Rule("figures_snn.py", "--scenarios 1"),
    Rule("compare_snn.py"),
    Rule(
        "bench_snn.py",
        "--robots 1 --block 1 --control-steps 1 --repeats 1 --no-accuracy --memory-robots 2",
    ),
    Rule("train_rl.py ppo D1", f"{_LEARNER} --scenarios D1 --set config.n_updates=1"),
    Rule("train_rl.py D1", f"{_LEARNER} --scenarios D1"),
    Rule("train_rl.py", f"{_LEARNER} --scenarios 1"),
)
