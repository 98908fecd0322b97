"""What every command does around its work: parse, run, print the result, leave with a status."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from snn_fusion_failure.runs.console import fail, print_result

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells count it: 128 + SIGINT."""
_KEPT = "what was finished is kept; the same command with --resume goes on where it keeps a folder"


class WorkFailedError(RuntimeError):
    """A command ran to its end, but a part of its work failed or is missing: exit status 1."""


def run_command(
    config: Any,
    main: Callable[[Any], Any],
    *,
    description: str | None,
    fields: Callable[[Any], Mapping[str, Any]] | None = None,
    argv: Sequence[str] | None = None,
    prog: str | None = None,
) -> None:
    """Parse `argv` into `config`, call `main(config)` and print `fields` of what it returns.

    Args:
        config: dataclass, or union of dataclasses (sub-commands), that tyro parses into.
        main: the work; raises ValueError or FileNotFoundError for bad input. A KeyboardInterrupt
            may carry the words that say how to go on.
        description: text of `--help`.
        fields: from what `main` returns to the `result:` line; None where `main` prints it.
        argv: the arguments; those of the process when left out.
        prog: name of the command in `--help`; the script's when left out.

    Raises:
        SystemExit: 2 after bad input, 1 after failed or missing work (`main` returned a true
            `failed` or `missing`, or raised :class:`WorkFailedError`), 130 after Ctrl-C. A command
            that returns has worked.

    Example:
        >>> import dataclasses
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     n: int = 3
        >>> def main(config: Config) -> dict[str, int]:
        ...     return {"sum": sum(range(config.n))}
        >>> run_command(Config, main, description=None, fields=dict, argv=[])
        result: sum=3
    """
    import tyro

    options = tyro.cli(config, description=description, args=argv, prog=prog)
    try:
        found = main(options)
    except (ValueError, FileNotFoundError) as error:
        fail(str(error))
    except WorkFailedError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from error
    except KeyboardInterrupt as error:
        print(f"interrupted: {str(error) or _KEPT}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    if fields is not None:
        print_result(**fields(found))
    if isinstance(found, Mapping) and (found.get("failed") or found.get("missing")):
        raise SystemExit(1)
