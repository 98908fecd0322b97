"""How many cars keep an anchor when the lidar fails? The bound that no training can pass.

    python scripts/studies/study_anchors.py --data SIM

SIM is a folder of prepared frames (`scripts/train_detector.py prepare`). For each failure of the
lidar at full severity: the share of labelled cars that an anchor overlaps by 0.5 or more on the
ground, with the spare rows of the anchor table filled evenly over the area and with them left
empty, as AVOD does. Prints a table and writes `results/study_anchors.json`. Half a CPU-second a
frame, most of it compiling.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_options import SizeOption
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, print_result, repository, run_command

TITLE = "Cars that keep an anchor when the lidar fails"
OVERLAP = 0.5


@dataclasses.dataclass(frozen=True)
class Config:
    """Count cars with an anchor."""

    data: Path
    """Folder of frames."""
    size: SizeOption = "small"
    cache: Path | None = None
    """Where the prepared examples are; DATA/cache_SIZE when left out."""
    split: str = "val"
    frames: int = 60
    """At most so many frames, the first ones."""
    results: Path = repository.RESULTS


def recall(config: Config) -> dict[tuple[str, str], float]:
    """Share of cars with an anchor [%] by failure and by what fills the spare rows."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from fusion.detection.geometry import anchor_ground, box3d_to_anchor, pairwise
    from fusion.detection.learning.cache import open_cache, read_example
    from fusion.detection.learning.examples import make_inputs
    from fusion.detection.learning.training import SENSOR_FAILURES, fail_sensor

    cache = open_cache(config.cache or config.data / f"cache_{config.size}")
    base = cache.config("avod")
    names = cache.names(config.split)[: config.frames]
    examples = [read_example(cache.examples(config.split), name) for name in names]
    found = {}
    for kind in (None, *(k for k in SENSOR_FAILURES if k.startswith("lidar"))):
        for model, fill in (("filled evenly", True), ("left empty", False)):
            anchors = dataclasses.replace(base.anchors, fill=fill)
            detector = dataclasses.replace(base, anchors=anchors)

            @jax.jit
            def best(key: Any, example: Any, kind: Any = kind, detector: Any = detector) -> Any:
                if kind is None:
                    inputs = make_inputs(detector, example)
                else:
                    inputs = fail_sensor(detector, example, kind, key=key)
                truth = anchor_ground(box3d_to_anchor(inputs.truth, square=True))
                overlap = pairwise(anchor_ground(inputs.anchors), truth)
                return jnp.where(inputs.anchor_mask[:, None], overlap, 0.0).max(axis=0)

            kept = []
            for i, example in enumerate(examples):
                overlap = best(jax.random.fold_in(jax.random.key(0), i), example)
                kept += np.asarray(overlap)[np.asarray(example.truth_mask)].tolist()
            found[kind or "clean", model] = 100.0 * float(np.mean(np.array(kept) >= OVERLAP))
    return found


def main(config: Config) -> dict[str, Any]:
    """Count, print the table, write the record."""
    from snn_fusion_failure.records import markdown

    enable_compilation_cache()
    rows = [
        {"row": row, "model": model, "metric": "cars_with_anchor", "unit": "%"} | summarize([value])
        for (row, model), value in recall(config).items()
    ]
    path = config.results / "study_anchors.json"
    record_table(path, "study_anchors", TITLE, rows, preset=config.size)
    print(markdown.measured(rows))
    fields = {f"{row['row']}_{row['model'].split()[0]}": row["mean"] for row in rows}
    print_result(rows=len(rows), **fields)
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
