"""The folder of the run logs: a name for a new one, room for it, and the oldest ones removed (`[log] keep`)."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.kept_records import IN_MEMORY
from jointctl.tools.written_file import writing

MESSAGE_BYTES = dtype_of(LogRecord).itemsize + 65  # of the log file for a record, its share of the joint states in it
UNKNOWN_S = 60.0  # room for a run until it is stopped


def log_path(config: Config) -> Path:
    """A new name in the log folder: configuration and local time."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = Path(config.log.folder)
    path = folder / f"{config.path.stem}-{stamp}.mcap"
    number = 1
    while path.exists():
        number += 1
        path = folder / f"{config.path.stem}-{stamp}-{number}.mcap"
    return path


def require_room(config: Config, path: Path) -> None:
    """`DataError` if the log of a run of this configuration could not be written to `path`; leaves nothing behind."""
    records = (config.trajectory.duration_s or UNKNOWN_S) * config.loop.rate_Hz
    needed = records * (MESSAGE_BYTES + (dtype_of(LogRecord).itemsize if records > IN_MEMORY else 0))
    with writing(path):
        new = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path.parent).free
        path.touch(exist_ok=False)
        path.unlink()
        for folder in new:
            folder.rmdir()
    if free < needed:
        raise DataError(
            f"{path.parent}: {free / 1e6:.0f} MB are free, the log of this run takes about {needed / 1e6:.0f} MB",
            "make room, or name another log.folder",
        )


def remove_oldest(config: Config, path: Path) -> list[Path]:
    """Keep the newest `log.keep` runs of this configuration, `path` counted as one; returns what was removed.

    A run is its log with the pictures and pages beside it, by name; nothing else in the folder is touched.
    """
    if not config.log.keep or not path.parent.is_dir():
        return []
    name = re.compile(
        rf"({re.escape(config.path.stem)}-\d{{8}}-\d{{6}}(?:-\d+)?)(?:\.tail|\.recording-\d+)?\.(?:mcap|png|html)"
    )
    runs: dict[str, list[Path]] = {}
    for file in path.parent.iterdir():
        if (found := name.fullmatch(file.name)) and found[1] != path.stem:
            runs.setdefault(found[1], []).append(file)
    oldest_first = sorted(runs, key=lambda run: max(file.stat().st_mtime for file in runs[run]))
    removed = [file for run in oldest_first[: max(0, len(runs) + 1 - config.log.keep)] for file in runs[run]]
    for file in removed:
        file.unlink()
    return removed
