"""configs/virtual.toml with lines replaced, and what is said about it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config

VIRTUAL = shipped_config("virtual").read_text()


def replaced(text: str, pattern: str, line: str) -> str:
    changed, count = re.subn(rf"^{pattern}", lambda _: line, text, count=1, flags=re.M)
    assert count == 1, pattern
    return changed


def load(tmp_path: Path, pattern: str = "", line: str = "", text: str = VIRTUAL) -> Config:
    path = tmp_path / "joint.toml"
    path.write_text(replaced(text, pattern, line) if pattern else text)
    return load_config(path)


def problems(tmp_path: Path, pattern: str, line: str, text: str = VIRTUAL) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, pattern, line, text)
    assert caught.value.exit_code == 3
    lines = caught.value.message.splitlines()
    prefix = f"{tmp_path / 'joint.toml'}: "
    assert all(x.startswith(prefix) for x in lines)
    return [x.removeprefix(prefix) for x in lines]
