"""`jointctl zero`: the angle here becomes 0, in the file only, shown before and after."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import DECLINED, ConfigurationError, DataError, DeviceError, NoDeviceError, UsageError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.verbs.zero import zero
from jointctl.tools.virtual_joint import new_device
from tests.configurations import shipped, written
from tests.device_on_bus import DeviceOnBus
from tests.sessions import output
from tests.two_encoders import NODE, config_with


def config_on(folder: Path, joint: DeviceOnBus, **changes: object) -> Config:
    path = written(folder / "mine.toml", bus__interface="virtual", bus__channel=joint.channel, **changes)
    return load_config(path)


def test_the_angle_here_becomes_zero_and_nothing_is_written_to_the_drive(tmp_path: Path, joint: DeviceOnBus) -> None:
    config = config_on(tmp_path, joint)
    before = config.path.read_text()
    said, _, err = output()
    assert zero(config, said, assume_yes=True) == 0
    after = load_config(config.path)
    assert after.encoder.zero_counts == 8344  # 0.1 rad
    assert "zero_counts 0 -> 8344" in err.getvalue()
    assert "the angle here +0.1000 rad -> +0.0000 rad" in err.getvalue()
    assert "+0.1000 rad from where they were" in err.getvalue()
    changed = [(a, b) for a, b in zip(before.splitlines(), config.path.read_text().splitlines(), strict=True) if a != b]
    assert len(changed) == 1
    assert {data[0] & 0xE0 for identifier, data in joint.requests if identifier == 0x601} == {0x40}


@pytest.mark.parametrize(("direction", "counts"), [(1, 8344 - 41722), (-1, 8344 + 41722)])
def test_another_angle_and_direction(tmp_path: Path, joint: DeviceOnBus, direction: int, counts: int) -> None:
    config = config_on(tmp_path, joint, encoder__direction=direction)
    said, out, _ = output(json=True)
    zero(config, said, angle_rad=0.5, assume_yes=True)
    assert load_config(config.path).encoder.zero_counts == counts
    found = json.loads(out.getvalue())
    assert found["angle_before_rad"] == pytest.approx(0.1 * direction, abs=1e-4)
    assert found["zero_counts"] == {"encoder": {"before": 0, "after": counts}}


def test_both_encoders_get_the_same_zero(tmp_path: Path) -> None:
    config = config_with(tmp_path, NODE, virtual__initial_position_rad=0.25, bus__interface="virtual")
    with DeviceOnBus(new_device(config)) as joint:
        path = written(config.path, **{
            "bus__interface": "virtual", "bus__channel": joint.channel, "joint_encoder": NODE, "encoder__side": "motor",
            "encoder__counts_per_turn": 65536,
        })  # fmt: skip
        zero(load_config(path), output()[0], assume_yes=True)
    after = load_config(path)
    assert after.joint_encoder.zero_counts == pytest.approx(100_000 + 0.25 / 6.283185307 * 524288, abs=2)
    assert after.encoder.zero_counts == pytest.approx(0.25 / 6.283185307 * 65536 * 121, abs=200)


def test_a_joint_that_moves_is_refused(tmp_path: Path, joint: DeviceOnBus) -> None:
    config = config_on(tmp_path, joint)
    before = config.path.read_text()
    joint.sequences[0x6064, 0] = [1000, 1000 + 8 + round(0.2 * config.limits.standstill_radps * 83443) + 1]
    with pytest.raises(DeviceError, match=r"the joint moves: \[encoder\] went from 1000 to"):
        zero(config, output()[0], assume_yes=True)
    assert config.path.read_text() == before
    joint.sequences[0x6064, 0] = [1000, 1000 + 8 + round(0.2 * config.limits.standstill_radps * 83443) - 1]
    assert zero(config, output()[0], assume_yes=True) == 0


def test_no_changes_nothing(tmp_path: Path, joint: DeviceOnBus, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_on(tmp_path, joint)
    before = config.path.read_text()
    with pytest.raises(UsageError, match="no terminal"):
        zero(config, output()[0])
    stdin = io.StringIO("n\n")
    stdin.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdin", stdin)
    assert zero(config, output()[0]) == DECLINED
    assert config.path.read_text() == before


def answered(monkeypatch: pytest.MonkeyPatch, first: Callable[[], None]) -> None:
    """The user says yes, after `first`."""

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

        def readline(self, *_: Any) -> str:
            first()
            return "y\n"

    monkeypatch.setattr(sys, "stdin", Terminal())


def test_what_happens_while_it_asks_counts(tmp_path: Path, joint: DeviceOnBus, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_on(tmp_path, joint)
    text = config.path.read_text()
    answered(monkeypatch, lambda: joint.sequences.update({(0x6064, 0): [20_000, 20_000]}))
    with pytest.raises(DeviceError, match=r"the joint moves: \[encoder\] went from 8344 to 20000 "):
        zero(config, output()[0])
    assert config.path.read_text() == text
    joint.sequences.clear()

    def edit() -> None:
        config.path.write_text(text + "# remembered while it asked\n")

    answered(monkeypatch, edit)
    assert zero(config, output()[0]) == 0
    assert config.path.read_text() == text.replace("zero_counts = 0   ", "zero_counts = 8344") + (
        "# remembered while it asked\n"
    )


def test_a_protected_file_stays_and_nothing_is_asked(
    tmp_path: Path, joint: DeviceOnBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_on(tmp_path, joint)
    text = config.path.read_text()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != config.path)
    with pytest.raises(DataError, match=r"mine.toml: cannot be written: no permission"):
        zero(config, output()[0], assume_yes=True)
    assert config.path.read_text() == text
    assert joint.requests == []


def test_what_is_refused(tmp_path: Path, joint: DeviceOnBus) -> None:
    with pytest.raises(ConfigurationError, match="is a shipped configuration"):
        zero(shipped(), output()[0], assume_yes=True)
    with pytest.raises(ConfigurationError, match=r"--angle \(=700\)"):
        zero(config_on(tmp_path, joint), output()[0], angle_rad=700.0, assume_yes=True)
    with pytest.raises(NoDeviceError, match="node 9"):
        zero(config_on(tmp_path, joint, drive__node=9), output()[0], assume_yes=True)


@pytest.mark.parametrize("line", ['"zero_counts" = 0', " zero_counts = 0"])
def test_a_zero_written_in_a_way_that_is_not_understood_leaves_the_file(
    tmp_path: Path, joint: DeviceOnBus, line: str
) -> None:
    config = config_on(tmp_path, joint)
    text = config.path.read_text().replace("zero_counts = 0", line, 1)
    config.path.write_text(text)
    with pytest.raises(ConfigurationError, match="in a way that is not understood") as refused:
        zero(load_config(config.path), output()[0], assume_yes=True)
    assert refused.value.hint == "write it as `zero_counts = 0` below [encoder], and try again"
    assert config.path.read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


def test_only_the_number_changes_in_a_file_of_any_habit(tmp_path: Path, joint: DeviceOnBus) -> None:
    config = config_on(tmp_path, joint)
    file, link = tmp_path / "real.toml", tmp_path / "link.toml"
    text = config.path.read_text()
    own = next(line for line in text.splitlines() if line.startswith("zero_counts = 0"))
    kept, given = "# zero_counts = 77    # in May", "zero_counts=+0  # 4 counts = 1 mm"
    before = "\ufeff" + text.replace(own, f"{kept}\n{given}").replace("\n", "\r\n")
    file.write_bytes(before.encode())
    file.chmod(0o640)
    link.symlink_to(file.name)
    assert zero(load_config(link), output()[0], assume_yes=True) == 0
    assert link.is_symlink()
    assert file.stat().st_mode & 0o777 == 0o640
    after = file.read_bytes().decode()
    assert after == before.replace(given, f"{'zero_counts = 8344':<33} # 4 counts = 1 mm")


@pytest.mark.parametrize(("angle_rad", "outside"), [(0.7, False), (0.71, True)])
def test_a_joint_outside_of_its_limits_is_warned_of(
    tmp_path: Path, joint: DeviceOnBus, angle_rad: float, outside: bool
) -> None:
    said, _, err = output()
    assert zero(config_on(tmp_path, joint), said, angle_rad=angle_rad, assume_yes=True) == 0
    assert ("the joint is outside of limits.position_*_rad" in err.getvalue()) is outside


def test_a_zero_that_the_file_cannot_hold_is_refused(tmp_path: Path, joint: DeviceOnBus) -> None:
    config = config_on(tmp_path, joint, encoder__counts_per_turn=2**26)
    before = config.path.read_text()
    with pytest.raises(ConfigurationError, match=r"encoder.zero_counts \(=-\d+\) must be in"):
        zero(config, output()[0], angle_rad=600.0, assume_yes=True)
    assert config.path.read_text() == before
