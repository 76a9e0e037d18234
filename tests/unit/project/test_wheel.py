"""What a wheel holds is what the tree holds, and it works from an empty folder without the tree."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.places import ROOT

TOP = ("firmware_py", "drivers", "hil", "tools", "configs")
BUILD = "import sys, setuptools.build_meta as b; b.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a copy of the tree, unpacked."""
    if int(version("setuptools").split(".")[0]) < 77:
        pytest.skip("the build needs setuptools 77 or newer")
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for name in TOP:
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, tree / name)
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=tree, check=True, capture_output=True, timeout=120.0)
    (wheel,) = out.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(out / "unpacked")
    return out / "unpacked"


def test_a_wheel_holds_every_file_of_the_tree_and_the_licence(unpacked: Path) -> None:
    def files(root: Path) -> set[str]:
        found = (file for top in TOP for file in (root / top).rglob("*"))
        return {str(f.relative_to(root)) for f in found if f.is_file() and "__pycache__" not in f.parts}

    assert files(unpacked) == files(ROOT)
    (metadata,) = unpacked.glob("*.dist-info/METADATA")
    assert "\nLicense-Expression: Apache-2.0\n" in metadata.read_text()
    assert list(unpacked.glob("*.dist-info/licenses/LICENSE"))


def test_it_works_from_an_empty_folder(unpacked: Path, tmp_path: Path) -> None:
    def jointctl(*words: str) -> str:
        return subprocess.run(
            [sys.executable, "-P", "-m", "tools.cli", *words], cwd=tmp_path, check=True, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(unpacked)}, timeout=120.0,
        ).stdout  # fmt: skip

    place = "import tools, configs; print(tools.__file__, configs.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    shown = subprocess.run(
        [sys.executable, "-P", "-c", place], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    assert shown.stdout.count(str(unpacked)) == 2
    jointctl("new", "joint.toml", "--from", "virtual")
    assert (tmp_path / "joint.toml").read_text() == (ROOT / "configs" / "virtual.toml").read_text()
