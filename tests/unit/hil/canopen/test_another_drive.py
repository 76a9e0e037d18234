"""The virtual drive with the objects of another drive's EDS: what SDO shows, what the driver says."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.hil.canopen.device import Cia402Device
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.verbs.hil import with_eds
from jointctl.tools.virtual_joint import new_device
from tests.configurations import shipped, written
from tests.device_on_bus import DeviceOnBus
from tests.eds_styles import EPOS4, EPOS4_KEYS, GOLD, NANOTEC, STYLES, U8, U16, U32, Listed, Style, eds_text
from tests.virtual_drive import NODE, Rig

NO_OBJECT, TOO_LONG = 0x06020000, 0x06070012
RATED = {"rated_torque": "rated_torque_Nm", "rated_current": "rated_current_A"}
each_style = pytest.mark.parametrize("style", STYLES, ids=lambda style: style.name)


def config_of(folder: Path, text: str, node: int = 1) -> Config:
    path = folder / "maker.eds"
    path.write_text(text, encoding="latin-1", newline="")
    return with_eds(shipped(drive__node=node), path)


def rig_of(folder: Path, style: Style) -> Rig:
    return Rig(device=new_device(config_of(folder, eds_text(style), NODE)))


def with_objects(style: Style, *objects: Listed) -> Style:
    return dataclasses.replace(style, objects=(*style.objects, *objects))


def upload(device: Cia402Device, index: int, sub: int = 0) -> int:
    """The abort code, 0 if there is an answer."""
    request = struct.pack("<BHB4x", 0x40, index, sub)
    answer = device.sdo.handle(request)[0]
    return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0


@each_style
def test_what_the_file_lists_is_there_and_nothing_else(tmp_path: Path, style: Style) -> None:
    device = rig_of(tmp_path, style).device
    listed = {(each.index, each.sub) for each in style.objects}
    assert set(device.objects.entries) == listed
    assert {place for place in listed if upload(device, *place)} == set()
    assert upload(device, 0x6099, 1) == upload(device, 0x1010, 1) == NO_OBJECT


@each_style
def test_identity_and_modes_are_those_of_the_file(tmp_path: Path, style: Style) -> None:
    rig = rig_of(tmp_path, style)
    assert rig.get(0x1018, 1) == style.vendor_id
    assert rig.get(0x6502) == style.modes
    taken = {mode for mode in range(1, 11) if rig.write(0x6060, 0, mode, 1) == 0}
    assert taken == {mode for mode in (1, 3, 4, 6, 8, 9, 10) if style.modes >> mode - 1 & 1}


@each_style
def test_what_commissioning_says(tmp_path: Path, style: Style) -> None:
    config = config_of(tmp_path, eds_text(style))
    drive = {"rated_torque_Nm": None, "rated_current_A": None, "torque_reference": style.reference, "mode": "auto"}
    drive[RATED[style.reference]] = getattr(config.drive, RATED[style.reference])
    config = config.changed(drive=drive)
    with DeviceOnBus(new_device(config)) as joint:
        joint.settings = dataclasses.replace(canopen_settings(config), boot_timeout_s=0.2)
        with joint.opened() as opened:
            if not style.refusal:
                assert opened.commission().mode == "cyclic_sync_torque"
                return
            with pytest.raises(DeviceError) as refused:
                opened.commission()
    assert style.refusal in str(refused.value)


@pytest.mark.parametrize(
    ("reference", "current_A", "torque_Nm", "rated"),
    [("rated_current", 4.0, None, (4000, 400)), ("rated_torque", None, 0.6, (6000, 600)),
     ("rated_current", 4.0, 0.7, (4000, 700))],
)  # fmt: skip
def test_the_rated_value_that_is_not_given_follows_from_the_torque_constant(
    tmp_path: Path, reference: str, current_A: float | None, torque_Nm: float | None, rated: tuple[int, int]
) -> None:
    drive = {"rated_current_A": current_A, "rated_torque_Nm": torque_Nm, "torque_reference": reference}
    path = written(tmp_path / "joint.toml", **{f"drive__{key}": value for key, value in drive.items()})
    objects = new_device(load_config(path)).objects
    assert (objects.default(0x6075, 0), objects.default(0x6076, 0)) == rated


@pytest.mark.parametrize(
    ("reference", "key"), [("rated_current", "rated_current_A"), ("rated_torque", "rated_torque_Nm")]
)
def test_the_rated_value_that_torque_refers_to_must_be_there(tmp_path: Path, reference: str, key: str) -> None:
    path = written(tmp_path / "joint.toml", **{"drive__torque_reference": reference, f"drive__{key}": None})
    with pytest.raises(ConfigurationError, match=rf"drive\.{key} is missing"):
        load_config(path)


def test_an_object_of_the_maker_keeps_what_is_written_until_a_reset(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, NANOTEC)
    assert rig.get(0x2031) == 1000
    rig.set(0x2031, 0, 2500, 4)
    assert rig.get(0x2031) == 2500
    assert rig.write(0x2031, 0, 1, 2) != 0
    assert rig.get(0x3212, 1) == -5
    rig.operational()
    rig.send(0, bytes([0x81, NODE]))
    rig.run(5)
    rig.set(0x6040, 0, 0, 2)
    assert rig.get(0x2031) == 1000


def test_a_sign_of_the_file_that_is_not_the_cores(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, NANOTEC)
    assert rig.device.objects.entries[0x608F, 1].dtype == np.dtype("<i4")
    assert rig.get(0x608F, 1) == 524288  # of the joint, not of the file


def test_a_default_of_0_counts_as_left_open(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, GOLD)
    assert rig.get(0x6087) == rig_of(tmp_path, NANOTEC).get(0x6087) > 0
    assert rig_of(tmp_path, NANOTEC).get(0x6072) == 100


def test_limits_of_communication_objects_are_the_standards(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, GOLD)
    rig.set(0x1016, 1, 126 << 16 | 200, 4)
    assert rig.get(0x1016, 1) == 126 << 16 | 200


def test_it_moves_in_a_mode_that_it_has(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, GOLD)
    rig.operational()
    rig.set(0x6072, 0, 1000, 2)
    rig.enable(10)
    rig.set(0x6071, 0, 800, 2)
    rig.run(200)
    assert abs(rig.speed_radps) > 1e-3
    assert abs(rig.get(0x6077)) > 0


@pytest.mark.parametrize(("data_type", "rated_counts"), [(U8, 100.0), (U16, 500.0), (U32, 5e6)])
@pytest.mark.parametrize("target", [199, 200, 201, -201, 900])
def test_the_makers_own_limit_bounds_the_torque_whatever_is_commanded(
    tmp_path: Path, data_type: int, rated_counts: float, target: int
) -> None:
    """200 permille; in the file its default is 0, which leaves twice the rated value."""
    limit = Listed(0x3001, 2, data_type, "rw", "0")
    objects = (*(each for each in EPOS4.objects if each.index != 0x3001), limit)
    (tmp_path / "maker.eds").write_text(eds_text(dataclasses.replace(EPOS4, objects=objects)), encoding="latin-1")
    keys = {f"drive__{key}": value for key, value in EPOS4_KEYS.items()}
    counts = {"drive__torque_limit_rated_counts": rated_counts, "drive__node": NODE}
    rig = Rig(device=new_device(load_config(written(tmp_path / "joint.toml", **{**keys, **counts}))))
    assert rig.get(0x3001, 2) == 2.0 * rated_counts
    rig.set(0x3001, 2, round(0.2 * rated_counts), {U8: 1, U16: 2, U32: 4}[data_type])
    rig.enable(10)
    rig.set(0x6071, 0, target, 2)
    rig.run(2)
    drive = rig.device.device[0].drive
    assert abs(int(drive.demand_torque)) == min(abs(target), 200)
    assert rig.get(0x6041) >> 11 & 1 == (abs(target) > 200)


@pytest.mark.parametrize(
    ("listed", "default"),
    [
        (Listed(0x1600, 0, 5, "rw", "9"), None),  # more than the core packs
        (Listed(0x1600, 0, 5, "rw", "8"), "0x60640020"),  # 32 bytes
        (Listed(0x1600, 0, 5, "rw", "1"), "0x20000001"),  # one bit
    ],
)
def test_a_default_mapping_that_cannot_be_packed_begins_empty(
    tmp_path: Path, listed: Listed, default: str | None
) -> None:
    objects = tuple(
        listed if (each.index, each.sub) == (0x1600, 0)
        else dataclasses.replace(each, default=default) if each.index == 0x1600 and default
        else each
        for each in GOLD.objects
    )  # fmt: skip
    assert rig_of(tmp_path, dataclasses.replace(GOLD, objects=objects)).get(0x1600, 0) == 0
    good = dataclasses.replace(listed, default="1")
    objects = tuple(
        good if each is listed
        else dataclasses.replace(each, default="0x60400010") if each.index == 0x1600 and each.sub == 1
        else each
        for each in objects
    )  # fmt: skip
    assert rig_of(tmp_path, dataclasses.replace(GOLD, objects=objects)).get(0x1600, 0) == 1


def test_a_count_of_mapped_objects_beyond_the_cores_is_refused(tmp_path: Path) -> None:
    more = [Listed(0x1600, sub, 7, "rw", "0") for sub in range(9, 65)]
    rig = rig_of(tmp_path, with_objects(GOLD, *more))
    rig.set(0x1400, 1, 0x80000200 + NODE, 4)
    assert rig.write(0x1600, 0, 9, 1) == 0x06040042
    assert rig.write(0x1600, 0, 0, 1) == 0


def test_an_odd_type_of_an_object_of_the_core_is_only_stored(tmp_path: Path) -> None:
    odd = tuple(dataclasses.replace(each, data_type=6) if each.index == 0x6087 else each for each in GOLD.objects)
    rig = rig_of(tmp_path, dataclasses.replace(GOLD, objects=odd))
    slope = int(rig.device.device[0].drive.torque_slope)
    assert rig.write(0x6087, 0, 77, 4) == TOO_LONG
    rig.set(0x6087, 0, 77, 2)
    assert rig.get(0x6087) == 77
    assert int(rig.device.device[0].drive.torque_slope) == slope > 77


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="must name a file"):
        with_eds(shipped(), tmp_path / "none.eds")
    with pytest.raises(ConfigurationError, match="describes no object"):
        new_device(config_of(tmp_path, "nothing\n"))
    encoder = (SHIPPED_FOLDER / "joint_encoder.eds").read_text()
    words = r"maker.eds\) is not that of a CiA 402 drive: it has no 6040 \(controlword\) and no 6041"
    with pytest.raises(ConfigurationError, match=words):
        new_device(config_of(tmp_path, encoder))
    with pytest.raises(ConfigurationError, match=r"drive\.kind"):
        with_eds(shipped("elmo_serial"), tmp_path / "maker.eds")


def test_only_what_the_file_has_is_saved(tmp_path: Path) -> None:
    store = (
        Listed(0x1010, 0, 5, "ro", "1"),
        Listed(0x1010, 1, 7),
        Listed(0x1011, 0, 5, "ro", "1"),
        Listed(0x1011, 1, 7),
    )
    rig = rig_of(tmp_path, with_objects(EPOS4, *store))
    rig.set(0x3001, 2, 1234, 4)
    rig.set(0x1010, 1, 0x65766173, 4)
    rig.send(0, bytes([0x81, NODE]))
    rig.run(5)
    rig.set(0x6040, 0, 0, 2)
    assert rig.get(0x3001, 2) == 1234
