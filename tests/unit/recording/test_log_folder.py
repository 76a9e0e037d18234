"""Name, room and age of run logs, and what is refused before the user is asked."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from jointctl.drivers.errors import DataError, MotionFault
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.log_folder import log_path, remove_oldest, require_room
from jointctl.tools.session.consent import prepare_log, require_ready


class Usage(NamedTuple):
    total: int
    used: int
    free: int


@pytest.fixture
def in_folder(virtual_config: Config, tmp_path: Path) -> Callable[..., Config]:
    """configs/virtual.toml with its logs in the test's folder."""

    def build(**log: Any) -> Config:
        section = virtual_config.log.model_copy(update={"folder": str(tmp_path), **log})
        config = virtual_config.model_copy(update={"log": section})
        config._path = virtual_config.path
        return config

    return build


def report(start_rad: float) -> Any:
    return SimpleNamespace(start_position_rad=start_rad)


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def aged(folder: Path, count: int) -> None:
    for i in range(count):
        for end in (".mcap", ".png", ".tail.mcap"):
            file = folder / f"virtual-2026010{i}-120000{end}"
            file.write_text("a log")
            os.utime(file, (1000.0 + i, 1000.0 + i))


def test_a_name_that_is_taken_is_not_given_again(in_folder: Callable[..., Config]) -> None:
    config = in_folder()
    paths = []
    for _ in range(3):
        paths.append(log_path(config))
        paths[-1].write_text("")
    assert len(set(paths)) == 3


@pytest.mark.parametrize(
    ("files", "words"), [(0, ""), (1, ": 1 file of older runs removed"), (3, ": 3 files of older")]
)
def test_what_is_removed_is_told(in_folder: Callable[..., Config], tmp_path: Path, files: int, words: str) -> None:
    for end in (".mcap", ".png", ".tail.mcap")[:files]:
        (tmp_path / f"virtual-20260101-120000{end}").write_text("a log")
    config, said = in_folder(keep=1), StringIO()
    prepare_log(config, log_path(config), Output(stdout=StringIO(), stderr=said))
    assert words in said.getvalue()
    assert bool(said.getvalue()) == bool(files)


@pytest.mark.parametrize(("keep", "left"), [(1, 0), (2, 1), (4, 3), (5, 4), (6, 4), (0, 4)])
def test_only_the_newest_runs_are_kept_with_the_new_one(
    in_folder: Callable[..., Config], tmp_path: Path, keep: int, left: int
) -> None:
    aged(tmp_path, 4)
    config = in_folder(keep=keep)
    removed = remove_oldest(config, log_path(config))
    assert len(removed) == 3 * (4 - left)
    expected = [
        f"virtual-2026010{i}-120000{end}" for i in range(4 - left, 4) for end in (".mcap", ".png", ".tail.mcap")
    ]
    assert names(tmp_path) == sorted(expected)


def test_files_that_are_not_runs_of_this_configuration_stay(in_folder: Callable[..., Config], tmp_path: Path) -> None:
    others = [
        "virtual-notes.mcap",
        "other-20260101-120000.mcap",
        "virtual-20260101-120000.csv",
        "my-virtual-20260101-120000.png",
    ]
    for name in others:
        (tmp_path / name).write_text("mine")
    config = in_folder(keep=1)
    assert remove_oldest(config, log_path(config)) == []
    assert names(tmp_path) == sorted(others)


@pytest.mark.parametrize(("factor", "refused"), [(0.99, True), (1.01, False)])
def test_a_disk_without_room_for_the_run_is_told(
    in_folder: Callable[..., Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float, refused: bool
) -> None:
    config = in_folder()
    needed = 10.0 * 1000.0 * (dtype_of(LogRecord).itemsize + 40)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, int(needed * factor)))
    if refused:
        with pytest.raises(DataError, match="MB are free, the log of this run takes about 4 MB"):
            require_room(config, log_path(config))
    else:
        require_room(config, log_path(config))
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_made_is_told(in_folder: Callable[..., Config], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    config = in_folder(folder=str(tmp_path / "file" / "runs"))
    with pytest.raises(DataError, match=r"file/runs/.*cannot be written"):
        require_room(config, log_path(config))


@pytest.mark.parametrize("start_rad", [-0.7001, 0.7001])
def test_a_joint_outside_its_limits_is_told_before_anybody_is_asked(
    in_folder: Callable[..., Config], start_rad: float
) -> None:
    config = in_folder()
    with pytest.raises(MotionFault, match=r"POSITION_LIMIT \(1\): the joint stands at .0?.7001 rad, .*\[-0.7..0.7\]"):
        require_ready(config, report(start_rad), log_path(config))


@pytest.mark.parametrize("start_rad", [-0.7, 0.0, 0.7])
def test_a_joint_at_its_limits_is_ready(in_folder: Callable[..., Config], start_rad: float) -> None:
    config = in_folder()
    require_ready(config, report(start_rad), log_path(config))
