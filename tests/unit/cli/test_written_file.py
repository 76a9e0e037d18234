"""Where results go is tried before the work that makes them."""

from __future__ import annotations

import io
import os
from pathlib import Path

import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.experiments.controller_study import StudySettings
from jointctl.tools.output import Output
from jointctl.tools.verbs import study as study_module
from jointctl.tools.written_file import prepare_folder, prepare_target, replace_file, require_target


def test_a_folder_is_made_and_one_that_is_there_stays(tmp_path: Path) -> None:
    prepare_folder(tmp_path / "a" / "b")
    prepare_folder(tmp_path / "a" / "b")
    prepare_target(tmp_path / "c" / "file.csv")
    prepare_target(None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "c"]


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="file: cannot be made: File exists"):
        prepare_folder(tmp_path / "file")
    with pytest.raises(DataError, match="is a folder, not a file to write"):
        prepare_target(tmp_path)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(DataError, match="no permission"):
        prepare_folder(tmp_path)


@pytest.mark.parametrize("key", ["csv", "figure"])
def test_a_study_is_not_begun(key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_module, "run_study", lambda *_, **__: pytest.fail("hours of simulation"))
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    folder = tmp_path / "folder.png"
    folder.mkdir()
    with pytest.raises(DataError, match="is a folder"):
        study_module.study(StudySettings(), output, **{key: folder})


@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_what_is_no_file_is_not_replaced_by_one(tmp_path: Path, kind: str) -> None:
    """As root, a new /dev/null would be an ordinary file."""
    path = tmp_path / "out.png"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null")
    before = os.stat(path)
    for refused in (require_target, prepare_target, lambda target: replace_file(target, b"x")):
        with pytest.raises(DataError, match="is a device, a FIFO or a socket, and only files are written"):
            refused(path)
    after = os.stat(path)
    assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)
