"""What makes each documented command quick enough to be run, and why some are not run at all."""

from __future__ import annotations

from snn_fusion_failure.documentation.robot_rules import ROBOTS
from snn_fusion_failure.documentation.rule import Rule

_TORCH = "compares with PyTorch, which the tests do not install (extra `bench`)"
_HAR = "--preset quick --seeds 1 --models baseline --shard 0/12 --out runs/tables"
_SEARCH = "--seeds 1 --threshold 1 --overwrite"
_STUDY = (
    "--seeds 1 --tasks box --methods pbo monte_carlo --n-total 51 --no-probability "
    "--out runs/study_failures"
)

_ACTIVE = "--samples 50 --steps 2 --specs"


def _threshold(folder: str) -> tuple[str, str]:
    """A file that saves the search for a threshold."""
    text = '{"threshold": 0.01, "nominal": 0.0, "worst": 0.02}'
    return f"runs/study_failures/{folder}/box/threshold.json", text


RULES = (
    # Not run. tests/snn_fusion_failure/test_check_commands.py holds their number.
    Rule("bench_snn.py --brian2-python", not_run="needs an interpreter with Brian 2"),
    Rule("bench_fusion.py", not_run=_TORCH),
    Rule("bench_bo.py", not_run="compares with BoTorch, which needs PyTorch (extra `bench`)"),
    Rule(
        "sweep.py --distributed", not_run="is one of two machines; test_sweep_layouts.py runs two"
    ),
    Rule("make demo", not_run="takes minutes and has no smaller size; test_demo.py runs its parts"),
    Rule("make", not_run="runs this or the test suite"),
    Rule(
        "sweep.py my_module:trial",
        not_run="is the reader's own module; check_wheel.py runs such a study",
    ),
    Rule("sweep.py show runs/mine", not_run="shows the sweep of the reader's own module"),
    Rule("pip install", not_run="installs; the Makefile does it"),
    Rule("pytest", not_run="is part of the test suite"),
    *ROBOTS,
    # Chapter 3.
    Rule("train_argate.py simulated", "--epochs 1 --overwrite"),
    Rule("train_argate.py", "--epochs 1 --preset quick --overwrite"),
    Rule("watch_sensors.py", "--preset quick --samples 80"),
    *(
        Rule(
            f"study_sensors.py {study}",
            "--preset quick --seeds 1 --models argate_plus --rows 'n_clean=8 uniform' "
            "--results runs",
        )
        for study in ("driver_heads", "driver_tagged", "driver_trip")
    ),
    Rule(
        "study_sensors.py gate_targets",
        "--preset quick --seeds 1 --models argate_l --rows masks --results runs",
    ),
    Rule(
        "study_sensors.py har_long",
        "--preset quick --seeds 1 --models linear_fit --rows 'n_clean=5 uniform' --results runs",
    ),
    Rule(
        "study_sensors.py",
        "--preset quick --seeds 1 --models argate_plus --rows zero --results runs",
    ),
    Rule("study_argate.py", "--preset quick --models argate_ws"),
    Rule(
        "study_spiking_fusion.py",
        "--preset quick --seeds 1 --models spiking_netgated --rows clean --results runs",
    ),
    Rule("study_rev_conv.py memory", "--depths 2 4 --results runs"),
    Rule(
        "study_rev_conv.py restoration",
        "--preset quick --seeds 1 --sensors body_acc_x --results runs",
    ),
    Rule(
        "study_rev_conv.py",
        "--preset quick --seeds 1 --models rev_conv_baseline --rows clean --results runs",
    ),
    Rule(
        "study_bayesian_gate.py",
        "--preset quick --seeds 1 --networks argate_l bayesian --train-only",
    ),
    Rule(
        "bench_lattice.py peer",
        "--steps 2 --repeats 1 --ranks 6 --calls 1",
        needs="pytorch_lattice",
    ),
    Rule("bench_lattice.py", "--steps 2 --repeats 1"),
    Rule("bench_streaming.py", "--slides 32 --turns 1"),
    Rule("simulate_kitti.py --picture", "--size tiny"),
    Rule("simulate_kitti.py", "--frames 2 --val 2 --test 2 --size tiny"),
    Rule("study_geometry.py", "--frames 2 --any-size"),
    Rule(
        "study_quality.py",
        "--data runs/kitti --size tiny --split val --frames 3 --steps 4 --seeds 1",
    ),
    Rule("study_anchors.py", "--data runs/kitti --size tiny --frames 2"),
    Rule(
        "draw_detections.py",
        "--data runs/kitti --min-cars 0 "
        "--found runs/detector/kitti_avod_argate_tiny_failures_s0/eval_val/data",
    ),
    Rule("train_detector.py prepare", "--size tiny --any-size"),
    Rule("train_detector.py train", "--size tiny --steps 1 --overwrite"),
    Rule(
        "train_detector.py calibrate",
        "--size tiny --false-alarm-rate 0.4",
    ),
    Rule("train_detector.py eval", "--size tiny --pictures 1"),
    Rule("train_detector.py drive", "--size tiny --frames 2"),
    Rule("train_detector.py robustness", "--size tiny --kinds camera_blackout --levels 5"),
    Rule("train_detector.py export", "--size tiny --points 2000", needs="flatbuffers"),
    Rule("evaluate_kitti.py"),
    Rule(
        "study_detector.py",
        "--size tiny --seeds 1 --steps 1 --kinds camera_blackout --any-size",
    ),
    Rule(
        "study_robustness.py",
        "--data runs/kitti --size tiny --seeds 1 --steps 1 --models dense "
        "--kinds camera_blackout lidar_loss --levels 5 --any-size --split val --results runs",
    ),
    Rule(
        "study_views.py",
        "--data runs/kitti --kinds camera_blackout --runs "
        "runs/detector/kitti_avod_argate_tiny_failures_s0",
    ),
    Rule("bench_detector.py", "--size tiny --repeats 1 --gemm 64"),
    Rule("bench_kitti_eval.py", "--frames 2 --repeats 1"),
    # Chapter 4.
    Rule("find_failures.py --netlist", "--n-total 40 --overwrite", needs="ngspice"),
    Rule("find_failures.py rev_argate_bnn", f"{_SEARCH} --n-total 51"),
    Rule("find_failures.py", f"{_SEARCH} --n-init 6 --n-total 8"),
    Rule(
        "study_failures.py dcdc",
        f"{_STUDY} --specs output_accuracy",
        held=_threshold("dcdc/output_accuracy"),
    ),
    Rule(
        "study_failures.py",
        f"{_STUDY} --specs load_regulation",
        held=_threshold("ldo/load_regulation"),
    ),
    # Samples of the searches above.
    Rule("study_active.py dcdc --runs", f"{_ACTIVE} output_accuracy --runs runs/study_failures"),
    Rule("study_active.py --runs", f"{_ACTIVE} load_regulation --runs runs/study_failures"),
    Rule("study_active.py", f"{_ACTIVE} undershoot"),
    Rule("study_circuits.py", "--starts 2 --steps 1 --samples 20"),
    Rule(
        "study_parity.py",
        "--parts ldo_ngspice ldo_grid box --ldo-samples 8 --grid-samples 2 --box-samples 8",
        needs="ngspice",
    ),
    Rule(
        "study_sigma.py",
        "--problems linear --specs --netlists --probabilities 1e-6 --methods lines --searches "
        "--seeds 1 --dim 12 --record runs/sigma.json",
    ),
    Rule(
        "study_level_sets.py",
        "--problems linear --specs --dim 12 --samples 20 --test-samples 20 --steps 2 --seeds 1 "
        "--record runs/level_sets.json",
    ),
    Rule("study_rare_events.py", "--runs 1 --n-importance 50 --n-subset 100 --replicates 3"),
    Rule("bench_circuits.py", "--batch 2 --repeats 1 --ngspice-samples 2", needs="ngspice"),
    Rule("bench_bo_steps.py", "--points 60 --dim 4 --steps 2 --out runs/bench_bo_steps.json"),
    Rule("bench_revnet.py", "--dim 6 --samples 16 --depths 1 2"),
    # All chapters.
    Rule("reproduce.py --report-only"),
    Rule("reproduce.py --collect-only"),
    Rule("reproduce.py 3.1", _HAR),
    Rule("reproduce.py 2.4", "--seeds 1 --models S4"),
    Rule("reproduce.py 2.3", "--preset quick --seeds 1 --models S4"),
    Rule("reproduce.py paper", "--preset quick --table 2.3 --seeds 1 --models S4"),
    Rule("reproduce.py quick", "--seeds 1 --models S4 baseline"),
    Rule("render_results.py"),
    Rule("render_api.py"),
    Rule("draw_architecture.py"),
    Rule("sweep.py show"),
    Rule("sweep.py lif", "--grid drive=16,40 neuron.tau_m=10 --seeds 2"),
    Rule(
        "sweep.py submitit",
        "--grid gamma=1e-4 --seeds 1 --workers 1 --cluster local --slurm timeout_min=5 "
        "--options max_steps=2 n_learn=1 n_test=2 --chunk-size 1",
        needs="submitit",
    ),
    Rule(
        "sweep.py --halving",
        "--grid gamma=1e-4,1e-3 --seeds 1 --halving 1 --keep 0.5 --chunk-size 1 "
        "--options max_steps=2 n_learn=2 n_test=2",
    ),
    Rule(
        "sweep.py --shard",
        "--study lif --grid drive=16,40 --seeds 1 --out runs/sweep_shard --chunk-size 1",
    ),
    Rule("sweep.py failure", "--seeds 1 --options n_init=4 n_total=6 candidates=8 refit_every=2"),
    Rule("sweep.py argate", "--seeds 1 --options epochs=1 model=baseline"),
    Rule("sweep.py snn", "--seeds 1 --options max_steps=2 n_learn=1 n_test=2 --chunk-size 1"),
    Rule("sweep.py", "--study lif --grid drive=16,40 --seeds 1 --out runs/sweep_bare"),
    Rule(
        "bench_sweep.py",
        "--repeats 2 --writers 1 --workers 1 --steps 100 --chunks 2 --no-snn --simulated 10",
    ),
    Rule("python -c"),
)

PLACEHOLDERS = {
    "$FUSION_DATA_DIR": "data",
    "/shared/": "runs/shared/",
    "$INDEX": "0",
    "my.json": "examples/room.json",
    "ROOT": "runs/kitti",
    "KITTI": "runs/kitti",
    "DIR": "runs/dir",
    "RESULTS": "runs/detector/kitti_avod_argate_tiny_failures_s0/eval_val/data",
}
"""What stands in the documentation for something of the reader's, and what it is here."""

AREAS = {
    "detector": (
        "simulate_kitti", "train_detector", "evaluate_kitti", "study_detector", "study_geometry",
        "study_robustness",
        "study_views", "study_anchors", "study_quality",
        "draw_detections", "bench_detector", "bench_kitti_eval",
    ),
    "robots": (
        "train_snn", "study_transfer", "study_snn", "figures_snn", "compare_snn", "bench_snn",
        "train_rl", "study_detour", "study_guidance", "study_lifelong", "study_families",
    ),
    "sweeps": ("sweep", "bench_sweep"),
    "fusion": (
        "train_argate", "watch_sensors", "study_argate", "study_sensors", "bench_fusion",
        "bench_streaming",
        "study_spiking_fusion", "study_rev_conv", "study_bayesian_gate", "bench_lattice",
        "reproduce",
    ),
    "circuits": (
        "find_failures", "study_failures", "study_active", "study_circuits", "study_parity",
        "study_rare_events", "study_sigma", "study_level_sets", "bench_circuits", "bench_revnet",
        "bench_bo", "bench_bo_steps",
    ),
}  # fmt: skip
"""Scripts that need each other's files or share compiled programs; the rest is one area, too."""
FUSION_DATA = "fusion"
"""The area that reads HAR and the driver's data."""
