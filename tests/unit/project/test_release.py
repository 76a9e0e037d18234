"""The release script: version, changelog, and that a release that fails leaves the tree as it was."""

from __future__ import annotations

import datetime
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.places import ROOT

RELEASE: dict[str, Any] = runpy.run_path(str(ROOT / "release"))
DAY = datetime.date(2026, 11, 23)
CHANGES = "# Changelog\n\n## [Unreleased]\n\n### Added\n\n- A thing.\n\n## [0.1.0] - 2026-01-01\n\n- Older.\n"


def test_the_version_is_written_once_and_only_grows() -> None:
    project = '[project]\nname = "jointctl"\nversion = "0.9.1"\n'
    assert 'version = "0.10.0"' in RELEASE["with_version"](project, "0.10.0")
    assert RELEASE["with_version"](project, "0.9.1") == project
    for wrong in ("0.9.0", "0.8.7", "1.0", "1.0.0rc1", "01.0.0", "v1.0.0"):
        with pytest.raises(SystemExit, match="version"):
            RELEASE["with_version"](project, wrong)


def test_what_was_unreleased_becomes_the_section_of_the_version() -> None:
    found = RELEASE["with_release"](CHANGES, "0.2.0", DAY)
    assert found == CHANGES.replace("## [Unreleased]", "## [Unreleased]\n\n## [0.2.0] - 2026-11-23")
    with pytest.raises(SystemExit, match="nothing below"):
        RELEASE["with_release"](found, "0.3.0", DAY)
    with pytest.raises(SystemExit, match="has been released"):
        RELEASE["with_release"](found, "0.2.0", DAY)


def test_the_present_changelog_and_version_can_be_released() -> None:
    version = RELEASE["VERSION"].search((ROOT / "pyproject.toml").read_text())[1]
    major = RELEASE["numbers"](version)[0]
    assert RELEASE["with_release"]((ROOT / "CHANGELOG.md").read_text(), f"{major + 1}.0.0", DAY)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A project whose build fails."""
    shutil.copy(ROOT / "release", tmp_path / "release")
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "x"\nversion = "0.1.0"\n[build-system]\nrequires = 3\n')
    (tmp_path / "CHANGELOG.md").write_text(CHANGES)
    git = ("git", "-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), ("commit", "-qm", "all")):
        subprocess.run([*git, *words], cwd=tmp_path, check=True)
    return tmp_path


def released(tree: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(tree / "release"), *words]
    return subprocess.run(command, cwd=tree, capture_output=True, text=True, timeout=300.0)


def test_a_tree_with_changes_is_not_released(tree: Path) -> None:
    (tree / "other").touch()
    done = released(tree, "0.2.0")
    assert done.returncode == 1
    assert "not committed" in done.stderr


def test_a_release_that_fails_puts_version_and_changelog_back(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")  # there is no `build` to be had
    done = released(tree, "0.2.0")
    assert done.returncode == 1
    assert "ended with exit code" in done.stderr
    assert (tree / "CHANGELOG.md").read_text() == CHANGES
    status = subprocess.run(["git", "status", "--porcelain"], cwd=tree, capture_output=True, text=True, check=True)
    assert status.stdout == ""
