"""A sweep and a configuration, as files."""

import shutil

import pytest

from jointctl.tools.configuration.load import shipped_config


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "joint.toml"
    shutil.copy(shipped_config("virtual"), path)
    return path
