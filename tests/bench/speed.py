"""The speed of this program against C, numpy and Python libraries, on this computer, in one run.

    python -m tests.bench.speed [--quick] [--out FOLDER] [--only law --only loop ...] [--json] [--quiet]

Writes a table, or JSON, to stdout, and bench.json and bench.png into the folder.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import typer

from jointctl.drivers.errors import JointctlError, UsageError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.output import Output
from jointctl.tools.verbs.main import app
from jointctl.tools.written_file import prepare_folder
from tests.bench.arm_speed import arm_rows
from tests.bench.exchange_speed import Rounds, arm_exchange_rows, exchange_rows
from tests.bench.law_speed import flexible_rows, law_rows
from tests.bench.paired import Row, conditions, outcome_data, outcome_table, skipped, write_outcome
from tests.bench.simulation_speed import lockstep_rows, program_rows, swarm_rows
from tests.bench.start_speed import start_rows

PARTS = ("law", "arm", "loop", "lockstep", "program", "swarm", "start")


def _law(config: Config, folder: Path, pairs: int) -> Iterator[Row]:
    def constants(of: Config) -> Any:
        return axis_constants(of, trajectory_table(of))

    yield from law_rows(constants(config), folder, pairs=pairs)
    flexible, rigid = (constants(load_config(shipped_config(name))) for name in ("realistic", "precise"))
    yield from flexible_rows(flexible, rigid, pairs=pairs)


def _part(name: str, config: Config, folder: Path, quick: bool, verbs: Sequence[str]) -> Iterator[Row]:
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        "law": lambda: _law(config, folder, 15 if quick else 61),
        "arm": lambda: chain(
            arm_rows(pairs=15 if quick else 61, runs=3 if quick else 15),
            arm_exchange_rows(folder, rounds=2 if quick else 16, seconds=1.0 if quick else 4.0),
        ),
        "loop": lambda: exchange_rows(
            config,
            folder,
            rounds=Rounds(in_c=2, cyclictest=1, in_python=1) if quick else Rounds(in_c=16, cyclictest=8, in_python=3),
            seconds=1.0 if quick else 2.0,
            quick=quick,
        ),
        "lockstep": lambda: lockstep_rows(config, runs=3 if quick else 15),
        "program": lambda: program_rows(config, runs=3 if quick else 15),
        "swarm": lambda: swarm_rows(pairs=1 if quick else 3, pyswarms_iterations=20 if quick else 100),
        "start": lambda: start_rows(config, runs=2 if quick else 7, cold=not quick, verbs=() if quick else verbs),
    }
    return parts[name]()


def bench(
    output: Output,
    *,
    quick: bool = False,
    out: Path | None = None,
    only: Sequence[str] = (),
    config_path: Path | None = None,
    verbs: Sequence[str] = (),
) -> int:
    """Measure and report; always 0, since a goal that is missed on a busy computer is no error.

    `only`: names of `PARTS`, all if empty.  `verbs`: whose start is timed.  `out`: folder for bench.json and bench.png.
    `quick` takes two minutes instead of half an hour, with few pairs and without the verbs: no basis for a claim.
    A virtual joint is started; no other is touched.
    """
    for name in only:
        if name not in PARTS:
            raise UsageError(f"only (={name}) must be one of {', '.join(PARTS)}")
    if out is not None:
        prepare_folder(out)
    # under load the library tells of every SDO that it repeats; a failure comes as an exception anyway
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    config = load_config(config_path or shipped_config("virtual"))
    found = conditions()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="jointctl-bench-") as folder:
        for name in [part for part in PARTS if not only or part in only]:
            output.note(f"  {name}")
            try:
                # one by one: what was measured before a part fails is kept
                for row in _part(name, config, Path(folder), quick, verbs):
                    rows.append(row)  # noqa: PERF402
            except JointctlError as error:
                rows.append(skipped(name, "the rest of this part", error.message))
    data = outcome_data(rows, found)
    output.result(outcome_table(rows), data)
    if out is not None:
        for path in write_outcome(out, rows, data):
            output.note(f"wrote {path}")
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """The exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="shorter, with more noise")
    parser.add_argument("--out", type=Path, help="folder for bench.json and bench.png")
    parser.add_argument("--only", action="append", default=[], help=", ".join(PARTS))
    parser.add_argument("--json", action="store_true", help="JSON on stdout instead of the table")
    parser.add_argument("--quiet", action="store_true", help="only the result")
    chosen = parser.parse_args(words)
    output = Output(json=chosen.json, quiet=chosen.quiet)
    commands: Any = typer.main.get_command(app)
    try:
        return bench(output, quick=chosen.quick, out=chosen.out, only=chosen.only, verbs=sorted(commands.commands))
    except JointctlError as error:
        output.error(error.message, error.hint)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
