"""What the archives hold is what the tree holds: wheel by way of the sdist, as an index would build it.

The wheel works from an empty folder, without the tree; the version is written once.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.message import Message
from email.parser import Parser
from importlib.metadata import version
from pathlib import Path

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.canopen import eds_path
from jointctl.tools.configuration.load import SHIPPED_FOLDER, load_config
from tests.places import ROOT

TOP = ("firmware_py", "drivers", "hil", "tools", "configs")
FACE = "interface"
READ = (
    "docs", "tests", "pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in",
    "check", "examples", "mkdocs.yml", "release",
)  # fmt: skip
BUILD = "import sys, setuptools.build_meta as b; getattr(b, 'build_' + sys.argv[1])(sys.argv[2])"


def build(kind: str, tree: Path, out: Path) -> Path:
    """The archive that the build back end makes of a tree."""
    done = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(out)],
        cwd=tree,
        check=True,
        capture_output=True,
        timeout=120.0,
        text=True,
    )
    assert "would be ignored" not in done.stderr  # a folder that is no package of pyproject.toml
    (archive,) = out.iterdir()
    return archive


def files(root: Path, *tops: str) -> set[str]:
    found = (file for top in tops for file in ([root / top] if (root / top).is_file() else (root / top).rglob("*")))
    return {str(f.relative_to(root)) for f in found if f.is_file() and "__pycache__" not in f.parts}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist of a copy of the tree, unpacked."""
    if int(version("setuptools").split(".")[0]) < 77:
        pytest.skip("the build needs setuptools 77 or newer")
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("sdist")
    for name in files(ROOT, *TOP, FACE, *READ):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    with tarfile.open(build("sdist", tree, out)) as archive:
        archive.extractall(out, filter="data")
    return next(folder for folder in out.iterdir() if folder.is_dir())


@pytest.fixture(scope="module")
def unpacked(sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of that, unpacked."""
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(build("wheel", sources, tmp_path_factory.mktemp("wheel"))).extractall(folder)
    return folder


@pytest.fixture(scope="module")
def metadata(unpacked: Path) -> Message:
    (file,) = unpacked.glob("*.dist-info/METADATA")
    return Parser().parsestr(file.read_text())


def test_the_sdist_holds_every_file_to_build_test_and_read(sources: Path) -> None:
    assert files(sources, *TOP, FACE, *READ) == files(ROOT, *TOP, FACE, *READ)


def test_a_wheel_holds_every_file_of_the_tree_and_nothing_else(unpacked: Path) -> None:
    package = unpacked / "jointctl"
    assert files(package, *TOP) == files(ROOT, *TOP)
    assert files(package, *(path.name for path in package.glob("*.py"))) == files(
        ROOT / FACE, *(path.name for path in (ROOT / FACE).glob("*.py"))
    )
    assert {folder.name for folder in package.iterdir() if folder.is_dir()} == set(TOP)
    assert {folder.name for folder in unpacked.iterdir() if folder.suffix != ".dist-info"} == {"jointctl"}


def test_what_the_metadata_say(unpacked: Path, metadata: Message) -> None:
    assert metadata["License-Expression"] == "Apache-2.0"
    assert list(unpacked.glob("*.dist-info/licenses/LICENSE"))
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["Description-Content-Type"] == "text/markdown"
    classifiers = metadata.get_all("Classifier")
    assert classifiers is not None
    assert not [name for name in classifiers if name.startswith("License ::")], "the SPDX expression stands alone"
    assert {f"Programming Language :: Python :: 3.{minor}" for minor in (11, 12, 13)} <= set(classifiers)


def test_the_version_is_that_of_the_project_file() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert version("jointctl") == project["version"]


def test_every_configuration_names_an_eds_that_is_shipped_or_marked() -> None:
    for file in SHIPPED_FOLDER.glob("*.toml"):
        try:
            config = load_config(file)
        except ConfigurationError:
            assert "FILL IN" in file.read_text()
            continue
        assert config.drive.kind != "canopen" or eds_path(config).parent == SHIPPED_FOLDER


def test_it_works_from_an_empty_folder(unpacked: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}

    def python(*words: str) -> str:
        return subprocess.run(
            [sys.executable, "-P", *words], cwd=tmp_path, check=True, capture_output=True, text=True, env=environment,
            timeout=120.0,
        ).stdout  # fmt: skip

    shown = python("-c", "import jointctl.tools, jointctl.configs as c; print(jointctl.tools.__file__, c.__file__)")
    assert shown.count(str(unpacked)) == 2
    python("-m", "jointctl.tools.verbs", "new", "joint.toml", "--from", "virtual")
    assert (tmp_path / "joint.toml").read_text() == (ROOT / "configs" / "virtual.toml").read_text()


def test_folders_of_the_user_with_our_names_do_not_matter(unpacked: Path, tmp_path: Path) -> None:
    """As under ROS 2, whose PYTHONPATH has many a `tools`."""
    for name in TOP:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('the wrong package')\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(unpacked)])}
    command = [sys.executable, "-P", "-m", "jointctl.tools.verbs", "--version"]
    shown = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, env=environment)
    assert shown.stdout.startswith("jointctl ")
    environment["PYTHONPATH"] = str(unpacked)
    code = f"import importlib.util as u; print([name for name in {TOP} if u.find_spec(name)])"
    shown = subprocess.run([*command[:2], "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert shown.stdout.strip() == "[]"
