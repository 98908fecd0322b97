"""Paired comparisons of the spiking networks over the seeds of the tables of record.

    python scripts/studies/compare_snn.py

Reads `results/table_2_3.json` to `table_2_5.json`, in which seed `i` of every network drives from
the same starts, and writes `results/study_paired_2_3.json` and so on: multiplicative against
additive learning (S2 - S1, S4 - S3), and networks with inhibitory hidden neurons against those
without (S3 - S1, S4 - S2), in points of the success rate in testing. From
`results/study_snn_trials.json` and `results/study_rl.json` it collects in one table,
`results/study_sample_efficiency.json`, after how many training trials at least 90 % of the trials
arrive on Scenarios 1-3 and D1-D3, and the share of learners that get there: spiking networks and
Q-learning (of their testing trials), PPO (of its latest training trials). A second.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import record_comparisons, record_table, rows_with_origin
from snn_fusion_failure.runs import repository, run_command

PAIRS = (("S2", "S1"), ("S4", "S3"), ("S3", "S1"), ("S4", "S2"))


@dataclasses.dataclass(frozen=True)
class Compare:
    """Where the tables are."""

    results: Path = repository.RESULTS
    metric: str = "sr_testing"


def compare(table: dict[str, Any], metric: str) -> list[dict[str, Any]]:
    """Rows of paired differences, for the pairs of which both networks are in the table."""
    from snn_fusion_failure.records.statistics import paired_test

    values = {r["model"]: r for r in table["rows"] if r["metric"] == metric}
    rows = []
    for better, worse in PAIRS:
        if better not in values or worse not in values:
            continue
        a, b = values[better]["values"], values[worse]["values"]
        n = min(len(a), len(b))
        if n < 2:
            continue
        test = paired_test(a[:n], b[:n])
        row = {"row": values[better]["row"], "comparison": f"{better} - {worse}", "metric": metric}
        rows.append(row | test._asdict())
    return rows


def sample_efficiency(results: Path) -> list[dict[str, Any]]:
    """Rows on the way to 90 % of all learners by map, from the studies that are there."""
    rows = []
    for name in ("study_snn_trials", "study_rl"):
        for row in rows_with_origin(results / f"{name}.json"):
            if row["metric"] in ("trials_to_90", "share_reaching_90"):
                rows.append(row | {"row": row["row"].removeprefix("trained on ")})
    return rows


def main(config: Compare) -> dict[str, int]:
    """Write the comparisons; returns how many each table has."""
    written = {}
    for number in ("2.3", "2.4", "2.5"):
        name = number.replace(".", "_")
        path = config.results / f"table_{name}.json"
        if not path.exists():
            continue
        table = json.loads(path.read_text(encoding="utf-8"))
        rows = compare(table, config.metric)
        if rows:
            record_comparisons(config.results, number, table["title"], rows, preset=table["preset"])
        written[number] = len(rows)
    rows = sample_efficiency(config.results)
    if rows:
        name = "study_sample_efficiency"
        title = "Training trials until 90 % arrive: of tests, PPO's of its latest training trials"
        path = config.results / f"{name}.json"
        record_table(path, name, title, rows, preset="paper")
    if not written:
        raise ValueError(
            f"{config.results} holds no table 2.3 to 2.5; run scripts/train_snn.py --record first"
        )
    return written


def fields(done: dict[str, int]) -> dict[str, int]:
    """What the result line says."""
    return {"comparisons": sum(done.values()), "tables": len(done)}


if __name__ == "__main__":
    run_command(Compare, main, description=__doc__, fields=fields)
