"""Objects 1010 and 1011 of the virtual drive: saved values come back after a reset, and after a restart with a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from jointctl.hil.canopen.device import DeviceSettings
from tests.virtual_drive import NODE, Rig

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")


def restart(rig: Rig, command: int = 0x81) -> None:
    rig.send(0, bytes([command, NODE]))
    rig.run(1)


def changed_rig(path: Path | None = None) -> Rig:
    rig = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    rig.set(0x1017, 0, 500, 2)
    rig.set(0x6072, 0, 800, 2)
    rig.set(0x6071, 0, 55, 2)
    rig.device._write(0x2100, 0, b"elbow")
    return rig


def values(rig: Rig) -> tuple[int, int, int, bytes]:
    rig.device.answer_sdo(bytes(16), rig.now_ns)  # the strings of a reset are restored with the next request
    return rig.get(0x1017), rig.get(0x6072), rig.get(0x6071), rig.device.objects.read(0x2100, 0)


@pytest.mark.parametrize(
    ("sub", "after"),
    [(1, (500, 800, 0, b"elbow")), (2, (500, 1000, 0, b"joint")), (3, (0, 800, 0, b"elbow"))],
)
def test_what_was_saved_comes_back_after_a_reset(sub: int, after: tuple[int, int, int, bytes]) -> None:
    rig = changed_rig()
    rig.set(0x1010, sub, SAVE, 4)
    assert rig.get(0x1010, sub) == 1
    restart(rig)
    assert values(rig) == after
    for part in (1, 2, 3):
        rig.set(0x1011, part, LOAD, 4)
    assert rig.get(0x6072) == after[1]  # not before the next reset
    restart(rig)
    assert values(rig) == (0, 1000, 0, b"joint")


def test_restoring_a_part_leaves_the_other() -> None:
    rig = changed_rig()
    rig.set(0x1010, 1, SAVE, 4)
    rig.set(0x1011, 2, LOAD, 4)
    restart(rig)
    assert values(rig) == (0, 800, 0, b"elbow")


def test_reset_communication_brings_back_the_saved_communication() -> None:
    rig = changed_rig()
    rig.set(0x1010, 2, SAVE, 4)
    rig.set(0x1017, 0, 100, 2)
    restart(rig, 0x82)
    assert values(rig) == (500, 800, 55, b"elbow")


@pytest.mark.parametrize("index", [0x1010, 0x1011])
@pytest.mark.parametrize("signature", [0, 1, SAVE ^ LOAD, int.from_bytes(b"evas", "little"), 0xFFFFFFFF])
def test_another_signature_is_refused(index: int, signature: int) -> None:
    rig = changed_rig()
    assert rig.write(index, 1, signature, 4) == 0x08000020
    assert rig.write(index, 1, SAVE if index == 0x1011 else LOAD, 4) == 0x08000020
    restart(rig)
    assert values(rig)[1] == 1000


@pytest.mark.parametrize(("words", "code"), [((0x06, 0x07), 0), ((0x06, 0x07, 0x0F), 0x08000022)])
def test_nothing_is_saved_while_the_motor_has_torque(words: tuple[int, ...], code: int) -> None:
    rig = changed_rig()
    rig.control(*words)
    assert rig.write(0x1010, 1, SAVE, 4) == code
    assert rig.write(0x1011, 1, LOAD, 4) == code


def test_a_file_outlives_the_drive(tmp_path: Path) -> None:
    path = tmp_path / "joint.json"
    rig = changed_rig(path)
    assert not path.exists()
    rig.set(0x1010, 1, SAVE, 4)
    again = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    assert values(again) == (500, 800, 0, b"elbow")
    again.set(0x1011, 1, LOAD, 4)
    assert json.loads(path.read_text()) == {}
    third = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    assert values(third) == (0, 1000, 0, b"joint")


def test_a_file_that_cannot_be_written_is_a_hardware_error(tmp_path: Path) -> None:
    rig = changed_rig(tmp_path / "gone" / "joint.json")
    assert rig.write(0x1010, 1, SAVE, 4) == 0x06060000
    restart(rig)
    assert values(rig)[0] == 0


@pytest.mark.parametrize("text", ["", "[]", '{"6041:0": 1}', '{"1017:0": "x"}', '{"1017:0": 70000}', '{"nonsense": 1}'])
def test_a_bad_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "joint.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"parameter file joint\.json: "):
        Rig(DeviceSettings(node_id=NODE, parameter_file=path))
