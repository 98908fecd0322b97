"""A training step on one device and one on two, in a process that has two: `gradients.npz`.

XLA makes two devices of a CPU only where it is asked before jax begins.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from fusion.detection.learning import fitting
from fusion.detection.learning.examples import make_example
from fusion.detection.learning.fitting import fit_detector, restore_detector
from fusion.detection.learning.training import DetectorTrainConfig
from fusion.detection.presets import preset
from tests.fusion.test_detection_network import a_frame


def main(out: Path) -> None:
    """Write the gradients of both, and the operations that a device does in a step."""
    made = preset("tiny")
    # Statistics over the batch, random bits in every layer, failures: all that frames share.
    config = dataclasses.replace(made.config, norm="batch", dropout=0.3, path_drop=0.3)
    train = DetectorTrainConfig(
        steps=1, batch_size=2, schedule="cosine", failure_share=0.5,
        failure_kinds=("camera_noise", "lidar_loss"),
    )  # fmt: skip
    examples = [make_example(config, a_frame(seed))[0] for seed in (0, 1)]
    work: list[float] = []
    original = fitting._step

    def counted(*arguments: Any) -> Callable[..., Any]:
        step = original(*arguments)

        def run(rates: Any, **named: Any) -> Any:
            compiled = step.lower(rates, **named).compile()
            work.append(float(compiled.cost_analysis()["flops"]))
            return compiled(rates, **named)

        return run

    fitting._step = counted  # type: ignore[assignment]
    for devices in (1, 2):
        fitted = fit_detector(
            config, train, made.params._replace(clip_norm=1e6), 2, examples.__getitem__, seed=0,
            report_every=1, devices=devices, checkpoint_dir=out / f"checkpoints_{devices}",
        )  # fmt: skip
        # Adam's first mean is a tenth of the gradient.
        means = optax.tree_utils.tree_get_all_with_path(fitted.state.opt_state, "mu")
        leaves = jax.tree_util.tree_leaves_with_path([mean for _, mean in means])
        held = {jax.tree_util.keystr(path): 10.0 * np.asarray(leaf) for path, leaf in leaves}
        np.savez(out / f"gradients_{devices}.npz", **held)
        (leaf, *_) = jax.tree.leaves(fitted.state.params)
        assert len(leaf.sharding.device_set) == devices
    # A training of two devices is read on one.
    state = restore_detector(config, out / "checkpoints_2")
    assert state is not None and int(state.step) == 1
    print(json.dumps(work))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
