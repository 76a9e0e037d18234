"""What watching costs the loop: the same run alone, with the scope served, and with a page open in a browser.

    python tests/bench/watching.py [--rounds 3] [--seconds 20]

The ways take turns, so that a computer that is busy with other things is so for all of them.  Prints a table and
JSON: wake-up lateness of the cycles while tracking (p50, p99, p99.9, max, of all rounds together), skipped cycles, and
the load average while it ran.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.firmware_py.states import AxisPhase  # noqa: E402
from jointctl.tools.recording.run_log_reader import read_run_log  # noqa: E402
from tests.bench.paired import separate_virtual_joint  # noqa: E402
from tests.browser import PROGRAM, Browser, free_port  # noqa: E402
from tests.configurations import written  # noqa: E402

WAYS = ("alone", "served, no page", "one page")
JOINTCTL = (sys.executable, "-P", "-m", "jointctl.tools.verbs")


def tracked(config: Path, way: str) -> Any:
    """The records of one run while it tracked."""
    port = free_port()
    scope = [] if way == "alone" else ["--scope", "--scope-port", str(port)]
    before = set(config.parent.glob("runs/*.mcap"))
    with Browser(config.parent / f"browser-{port}") if way == "one page" else nullcontext() as browser:
        run = subprocess.Popen([*JOINTCTL, "run", str(config), "-y", "--quiet", *scope], cwd=config.parent,
                               stdout=subprocess.DEVNULL)  # fmt: skip
        while browser is not None and run.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port), 1.0).close()
                browser.open(f"http://127.0.0.1:{port}/")
                break
            except OSError:
                time.sleep(0.1)
        if run.wait():
            raise SystemExit(f"{way}: the run ended with {run.returncode}")
    (log,) = (path for path in set(config.parent.glob("runs/*.mcap")) - before if "." not in path.stem)
    records = read_run_log(log).records
    return records[records["phase"] == AxisPhase.TRACKING]


def figures(rounds: list[Any]) -> dict[str, float]:
    """Of all rounds together."""
    late_us = np.concatenate([records["wake_late_ns"] for records in rounds]) / 1e3
    p50, p99, p999 = np.percentile(late_us, (50.0, 99.0, 99.9))
    skipped = sum(int(records["skipped"].sum()) for records in rounds)
    return {
        "cycles": len(late_us), "p50_us": float(p50), "p99_us": float(p99), "p99_9_us": float(p999),
        "max_us": float(late_us.max()), "skipped": skipped,
    }  # fmt: skip


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    ways = WAYS if PROGRAM is not None else WAYS[:2]
    found: dict[str, list[Any]] = {way: [] for way in ways}
    loads = []
    with tempfile.TemporaryDirectory() as folder:
        channel = f"watching-{os.getpid()}"
        config = written(Path(folder) / "joint.toml", bus__channel=channel, trajectory__duration_s=arguments.seconds)
        with separate_virtual_joint(config, channel):
            for number in range(arguments.rounds):
                for way in ways[number % len(ways) :] + ways[: number % len(ways)]:
                    found[way].append(tracked(config, way))
                    loads.append(os.getloadavg()[0])
    result = {way: figures(rounds) for way, rounds in found.items()}
    print(f"{'':16}{'cycles':>8}{'p50':>7}{'p99':>7}{'p99.9':>7}{'max':>8}  us{'skipped':>9}")
    for way, row in result.items():
        times = "".join(f"{row[key]:{width}.0f}" for key, width in
                        (("p50_us", 7), ("p99_us", 7), ("p99_9_us", 7), ("max_us", 8)))  # fmt: skip
        print(f"{way:16}{row['cycles']:8.0f}{times}    {row['skipped']:9.0f}")
    print(json.dumps({"ways": result, "load": [round(load, 1) for load in loads], "cores": os.cpu_count()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
