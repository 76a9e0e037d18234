"""Soak: a long real-time run on the virtual joint, and what it leaves behind.

    python tests/bench/soak.py --minutes 60 [--folder soak]

Watches resident memory and open handles of the three processes (`jointctl run`, its loop, the virtual joint), then
reads the log: records lost, and whether deadline N is start + N periods to the nanosecond.  Prints a table, writes
`soak.json` into the folder, and ends with 1 if records were lost, the schedule drifted or handles grew.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.tools.recording.run_log_reader import missing_records, read_run_log  # noqa: E402
from tests.bench.paired import separate_virtual_joint  # noqa: E402
from tests.configurations import written  # noqa: E402
from tests.python_process import child  # noqa: E402

SETTLED_S = 60.0  # memory of the first minute is start-up
COMPARED_S = 60.0  # first and last minute are compared


@dataclass
class Watched:
    """One process: (time [s], resident memory [bytes], open handles) every now and then."""

    pid: int
    rows: list[tuple[float, int, int]] = field(default_factory=list)

    def look(self, now_s: float) -> None:
        """Take a row; none if the process has gone."""
        try:
            pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
            handles = len(os.listdir(f"/proc/{self.pid}/fd"))
        except (FileNotFoundError, ProcessLookupError, IndexError):
            return
        self.rows.append((now_s, pages * os.sysconf("SC_PAGESIZE"), handles))

    def figures(self) -> dict[str, float]:
        """Medians of the first settled and of the last minute, and the slope between them."""
        rows = np.array(self.rows, float)
        rows = rows[rows[:, 0] >= min(SETTLED_S, 0.2 * rows[-1, 0])]
        first = np.median(rows[rows[:, 0] <= rows[0, 0] + COMPARED_S], axis=0)
        last = np.median(rows[rows[:, 0] >= rows[-1, 0] - COMPARED_S], axis=0)
        slope = np.polyfit(rows[:, 0], rows[:, 1], 1)[0] if len(rows) > 2 else float("nan")
        return {
            "first_MB": first[1] / 1e6,
            "last_MB": last[1] / 1e6,
            "slope_MB_per_hour": slope * 3600.0 / 1e6,
            "handles_first": first[2],
            "handles_last": last[2],
        }


def long_config(folder: Path, duration_s: float) -> Path:
    """configs/virtual.toml with a long trajectory, limits and gains that bear a standing machine.

    On a shared machine the shipped ones (50 ms) end the run with a fault sooner or later, as they should.
    """
    return written(
        folder / "soak.toml", trajectory__duration_s=duration_s, log__folder=str(folder),
        control__kind="computed_torque", control__kp=100.0, control__kv=20.0,
        limits__position_min_rad=-3.0, limits__position_max_rad=3.0, limits__velocity_max_radps=50.0,
        limits__following_error_max_rad=2.0, limits__position_jump_max_rad=2.0, limits__sample_age_max_s=1.0,
        limits__skipped_max_s=1.0, limits__saturation_max_s=5.0, sequence__brake_radps2=20.0,
        sequence__supervisor_timeout_s=10.0, drive__heartbeat_s=2.0,
    )  # fmt: skip


def schedule_figures(records: Any, period_ns: int) -> dict[str, int]:
    """How far the last deadline is from start + slots periods, and the largest such distance [ns]; skipped slots."""
    slots = np.cumsum(records["skipped"][1:].astype(np.int64) + 1)
    off_ns = np.asarray(records["time_ns"][1:] - records["time_ns"][0]) - slots * period_ns
    return {
        "drift_ns": int(off_ns[-1]),
        "largest_off_ns": int(np.abs(off_ns).max()),
        "skipped": int(records["skipped"].sum()),
    }


def soak(minutes: float, folder: Path, every_s: float) -> dict[str, Any]:
    """The run and its figures."""
    folder.mkdir(parents=True, exist_ok=True)
    config = long_config(folder, 60.0 * minutes)
    channel = f"soak-{os.getpid()}"
    load_before = os.getloadavg()
    with separate_virtual_joint(config, channel) as joint:
        command = [
            sys.executable,
            "-P",
            "-m",
            "jointctl.tools.verbs",
            "run",
            str(config),
            "-y",
            "--json",
            "-c",
            channel,
        ]
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        watched = {"run": Watched(run.pid), "virtual joint": Watched(joint.pid)}
        started_s = time.monotonic()
        loads = []
        while run.poll() is None:
            if "loop" not in watched:
                with contextlib.suppress(OSError, ValueError):  # not begun yet
                    watched["loop"] = Watched(child(run.pid, "loop_process"))
            now_s = time.monotonic() - started_s
            if now_s < 60.0 * minutes + 1.0:  # what comes later is the report's, not the run's
                for one in watched.values():
                    one.look(now_s)
                loads.append(os.getloadavg()[0])
            time.sleep(every_s)
        result = json.loads(run.stdout.read())
    log = read_run_log(result["log"])
    late_us = np.asarray(log.records["wake_late_ns"]) / 1e3
    tenth = max(len(late_us) // 10, 1)
    return {
        "minutes": minutes,
        "exit_code": run.returncode,
        "fault": result["fault"],
        "cycles": len(log.records),
        "log_complete": log.complete,
        "lost_records": result["lost_records"] + missing_records(log.records),
        **schedule_figures(log.records, 1_000_000),
        "wake_late_p50_us": {
            "first tenth": float(np.median(late_us[:tenth])),
            "last tenth": float(np.median(late_us[-tenth:])),
        },
        "wake_late_p99_us": float(np.quantile(late_us, 0.99)),
        "rmse_rad": result["error"] and result["error"]["rmse_rad"],
        "load_average": {"before": load_before[0], "mean": float(np.mean(loads)), "most": float(np.max(loads))},
        "cores": os.cpu_count(),
        "processes": {name: one.figures() for name, one in watched.items()},
    }


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--folder", type=Path, default=Path("soak"))
    parser.add_argument("--every", type=float, default=2.0, help="seconds between two looks at the processes")
    options = parser.parse_args()
    found = soak(options.minutes, options.folder.resolve(), options.every)
    text = json.dumps(found, indent=1)
    (options.folder / "soak.json").write_text(text + "\n")
    print(text)
    sound = found["exit_code"] == 0 and found["lost_records"] == 0 and found["drift_ns"] == 0
    handles = all(one["handles_last"] <= one["handles_first"] for one in found["processes"].values())
    return 0 if sound and handles else 1


if __name__ == "__main__":
    sys.exit(main())
