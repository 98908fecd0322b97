"""Run every command of README.md and docs/, each at its smallest size.

    python scripts/tools/check_commands.py
    python scripts/tools/check_commands.py --only train_snn reproduce
    python scripts/tools/check_commands.py --part 0/3

The commands are those that a reader finds, with the options of the table in
snn_fusion_failure/documentation/command_rules.py appended. They run in a copy of the repository in
a temporary folder, with made-up data sets and simulated KITTI frames, so that the repository and
its results/ are not touched. Commands of one area share a process, as a notebook would: what is
imported and compiled once serves the next. One line for each with its time; what is not run says
why; the log of a command that fails is shown. Exit status 1 when one fails. About nine minutes on
two cores, after the test suite has compiled."""

from snn_fusion_failure.documentation.check_commands import Config, main
from snn_fusion_failure.runs.command import run_command

if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
