"""Configurations that a test changes: a loaded one, or the text of a shipped file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from tests.places import CONFIGS

VIRTUAL = (CONFIGS / "virtual.toml").read_text()
SLOW_LOOP = {  # 100 Hz: gains for that rate, and limits for a busy computer
    "loop__rate_Hz": 100.0, "loop__priority": None, "drive__heartbeat_s": 0.8, "limits__sample_age_max_s": 1.0,
    "limits__skipped_max_s": 1.0, "limits__following_error_max_rad": 0.6, "limits__position_jump_max_rad": 0.1,
    "sequence__supervisor_timeout_s": 5.0, "control__kp": 36.0, "control__kv": 12.0, "control__lyapunov_q": 100.0,
    "control__learning_rate": 1.0, "control__velocity_cutoff_Hz": 25.0, "trajectory__amplitude_rad": 0.1,
    "virtual__initial_position_rad": 0.02,
}  # fmt: skip

KALMAN: dict[int, dict[str, Any]] = {  # keys of [control] for encoders of so many bits: docs/law.md, coarse encoders
    bits: {"velocity_filter": "kalman", "velocity_cutoff_Hz": cutoff_Hz, "observer_radps": observer, "kp": kp, "kv": kv}
    for bits, cutoff_Hz, observer, kp, kv in (
        (14, 40.0, 40.0, 2500.0, 100.0), (15, 50.0, 50.0, 3000.0, 110.0), (16, 80.0, 60.0, 3600.0, 120.0),
    )
}  # fmt: skip


def shipped(name: str = "virtual", **changes: Any) -> Config:
    """One of `configs`, with `section__key=value` changed."""
    return load_config(CONFIGS / f"{name}.toml").changed(**changes)


def own_loop(mode: str = "csp", **cascade: Any) -> Config:
    """The shipped csp.toml in this mode, with keys of [drive.cascade] changed."""
    config: Any = shipped("csp")
    return config.changed(drive__mode=mode, drive__cascade=config.drive.cascade.model_copy(update=cascade))


def edited_file(folder: Path, *changes: tuple[str, str], base: str = "virtual") -> Path:
    """A shipped file with pieces of text replaced, each of which is there exactly once."""
    text = (CONFIGS / f"{base}.toml").read_text()
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "joint.toml"
    path.write_text(text)
    return path


def edited(folder: Path, *changes: tuple[str, str], base: str = "virtual") -> Config:
    """The same, loaded."""
    return load_config(edited_file(folder, *changes, base=base))


def set_keys(document: Any, **changes: Any) -> None:
    """Set `section__key=value` in a parsed file; None removes the key."""
    for path, value in changes.items():
        *sections, key = path.split("__")
        table = document
        for section in sections:
            table = table.setdefault(section, tomlkit.table())
        if value is None:
            del table[key]
        else:
            table[key] = value


def written(path: Path, base: str = "virtual", **changes: Any) -> Path:
    """A shipped file with keys set or removed."""
    document = tomlkit.parse((CONFIGS / f"{base}.toml").read_text())
    set_keys(document, **changes)
    path.write_text(tomlkit.dumps(document))
    return path


def replaced(text: str, pattern: str, line: str) -> str:
    """The text with what matches `pattern` at the beginning of a line replaced, once."""
    changed, count = re.subn(rf"^{pattern}", lambda _: line, text, count=1, flags=re.M)
    assert count == 1, pattern
    return changed


def load(tmp_path: Path, pattern: str = "", line: str = "", text: str = VIRTUAL) -> Config:
    """configs/virtual.toml, or `text`, with such a line replaced."""
    path = tmp_path / "joint.toml"
    path.write_text(replaced(text, pattern, line) if pattern else text)
    return load_config(path)


def problems(tmp_path: Path, pattern: str, line: str, text: str = VIRTUAL) -> list[str]:
    """What is said about it, line by line."""
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, pattern, line, text)
    assert caught.value.exit_code == 3
    lines = caught.value.message.splitlines()
    prefix = f"{tmp_path / 'joint.toml'}: "
    assert all(x.startswith(prefix) for x in lines)
    return [x.removeprefix(prefix) for x in lines]
