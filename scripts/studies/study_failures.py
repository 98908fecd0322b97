"""Tables 4.1 and 4.2: all methods, all specifications, box and ball, many seeds.

    python scripts/studies/study_failures.py --circuit ldo --seeds 20 --out runs/table_4_1 --record
    python scripts/studies/study_failures.py --circuit dcdc --seeds 20 --out runs/table_4_2 --record

One folder per specification, task and method; every simulation is logged as it comes, so the
command can be killed and repeated. With `--record` the rows go to `results/table_4_1.json` or
`table_4_2.json` after every method. Thresholds: 90 % of the way from nominal to the worst value
that gradient ascents find; their probability for normal parameters by subset simulation.

For one specification, task and method: about 3 CPU-minutes for 20 seeds, 10 with Rev-ARGate.
"""

from snn_fusion_failure.records.failure_tables import Config, main
from snn_fusion_failure.runs.command import run_command

if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
