"""What an installed package holds is what the tree holds; the version is written once."""

from __future__ import annotations

import fnmatch
import importlib.metadata
import tomllib
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.canopen import eds_path
from jointctl.tools.configuration.load import SHIPPED_FOLDER, load_config
from tests.places import ROOT

TOP = ("firmware_py", "drivers", "hil", "tools", "configs")
NOT_SHIPPED = ("__pycache__",)


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_of_the_tree_is_installed(project: dict[str, Any]) -> None:
    folders = {file.parent.relative_to(ROOT).parts for top in TOP for file in (ROOT / top).rglob("__init__.py")}
    names = {".".join(("jointctl", *parts)) for parts in folders} | {"jointctl"}
    assert set(project["tool"]["setuptools"]["packages"]) == names


def test_every_module_is_in_a_package() -> None:
    for top in TOP:
        for file in (ROOT / top).rglob("*.py"):
            assert (file.parent / "__init__.py").exists(), file


def test_every_file_that_is_no_module_is_package_data(project: dict[str, Any]) -> None:
    patterns = project["tool"]["setuptools"]["package-data"]
    for top in TOP:
        for file in (ROOT / top).rglob("*"):
            if file.is_dir() or file.suffix in (".py", ".pyc") or set(NOT_SHIPPED) & set(file.parts):
                continue
            package = ".".join(("jointctl", *file.parent.relative_to(ROOT).parts))
            assert any(fnmatch.fnmatch(file.name, pattern) for pattern in patterns.get(package, ())), file


def test_the_version_is_that_of_the_project_file(project: dict[str, Any]) -> None:
    assert importlib.metadata.version("jointctl") == project["project"]["version"]
    assert project["project"]["license"] == "Apache-2.0"


def test_every_configuration_names_an_eds_that_is_shipped_or_marked() -> None:
    for file in SHIPPED_FOLDER.glob("*.toml"):
        try:
            config = load_config(file)
        except ConfigurationError:
            assert "FILL IN" in file.read_text()
            continue
        assert config.drive.kind != "canopen" or eds_path(config).parent == SHIPPED_FOLDER
