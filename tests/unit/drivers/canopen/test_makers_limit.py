"""A drive without 6072: the maker's own object bounds the torque, is only ever lowered, and is given back."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.load import load_config
from jointctl.tools.virtual_joint import new_device
from tests.configurations import written
from tests.device_on_bus import DeviceOnBus
from tests.eds_styles import EPOS4, EPOS4_KEYS, U16, Listed, eds_text

pytestmark = pytest.mark.usefixtures("short_timeout")
PLACE = (0x3001, 2)
READ_ONLY, OUT_OF_RANGE = 0x06010002, 0x06090030
HELD = 5000  # by the file's default: 60.5 Nm at the joint


def keys(**changes: Any) -> dict[str, Any]:
    """None: the file without that key."""
    kept = {key: value for key, value in EPOS4_KEYS.items() if key not in changes}
    return {
        f"drive__{key}": value for key, value in {**kept, **changes}.items() if key not in changes or value is not None
    }


def joint_of(folder: Path, *objects: Listed, **changes: Any) -> DeviceOnBus:
    """The virtual drive with the objects of the style, and the configuration that names its limit."""
    listed = {(each.index, each.sub): each for each in (*EPOS4.objects, *objects)}
    style = dataclasses.replace(EPOS4, objects=tuple(listed.values()))
    (folder / "maker.eds").write_text(eds_text(style), encoding="latin-1")
    config = load_config(written(folder / "joint.toml", **{**keys(), **changes}))
    settings = dataclasses.replace(canopen_settings(config), boot_timeout_s=0.2)
    return DeviceOnBus(new_device(config), settings)


def refusal(words: str) -> Any:
    return pytest.raises(DeviceError, match=words)


@pytest.fixture
def epos(tmp_path: Path) -> Iterator[DeviceOnBus]:
    with joint_of(tmp_path) as joint:
        yield joint


def test_it_is_written_read_back_and_given_back_when_the_drive_is_off(epos: DeviceOnBus) -> None:
    with epos.opened() as drive:
        report = drive.commission()
        assert report.mode == "cyclic_sync_torque"
        assert epos.value(*PLACE) == 4958  # 60 Nm of 60.5, rounded down
        assert report.settings["max torque"] == "3001:2 = 4958 (was 5000) = 60.0 Nm"
        assert f"no object 6072: the drive limits its torque by {report.settings['max torque']}" in report.remarks
        assert drive._objects.verified()[PLACE] == (4958, "torque limit")
        assert drive.make_safe() == "switch on disabled"
    assert epos.value(*PLACE) == HELD
    assert epos.downloads(*PLACE) == [4958, HELD]


def test_it_is_verified_once_more_before_the_loop_begins(epos: DeviceOnBus) -> None:
    with epos.commissioned() as drive:
        epos.store(*PLACE, HELD)
        with refusal(r"has changed .* object 3001:2 \(torque limit\) is 5000, 4958 was set"):
            drive.start_cyclic()
        assert drive.make_safe() == "switch on disabled"
    assert epos.downloads(*PLACE) == [4958]  # another program has set it since


def test_what_it_held_at_first_is_given_back_after_a_second_commissioning(epos: DeviceOnBus) -> None:
    with epos.commissioned(torque_max_Nm=12.1) as drive:
        drive.commission()
        drive.make_safe()
    assert epos.downloads(*PLACE) == [1000, 1000, HELD]


@pytest.mark.parametrize(("torque_max_Nm", "counts"), [(60.5, 5000), (60.52, None), (0.0121, 1), (0.0120, None)])
def test_it_is_never_raised_nor_rounded_up(epos: DeviceOnBus, torque_max_Nm: float, counts: int | None) -> None:
    with epos.opened(torque_max_Nm=torque_max_Nm) as drive:
        if counts is not None:
            drive.commission()
            assert epos.value(*PLACE) == counts
            return
        words = "needs 5001 in object" if torque_max_Nm > 60.0 else "below one count of object"
        with pytest.raises(
            DeviceError, match=rf"limits\.torque_max_Nm \(=.*\) .*{words[-15:]} 3001:2 \(torque limit\)"
        ):
            drive.commission()
    assert epos.downloads(*PLACE) == []


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("rated_counts", 5e6, r"needs 4958677 in .* holds 5000 = 0\.0605 Nm and is only ever lowered"),
        ("rated_counts", 5, r"torque_max_Nm \(=60\) would be cut to 48\.4 Nm by object 3001:2 .* count is 12\.1 Nm"),
        ("object", "2110", r"maker\.eds has no object 2110 \(torque limit\)"),
    ],
    ids=["a unit that is wrong by a thousand", "counts so coarse that the torque would be cut", "no such object"],
)
def test_what_the_file_says_of_it_and_the_drive_does_not_is_refused(
    tmp_path: Path, key: str, value: Any, words: str
) -> None:
    with joint_of(tmp_path, **{f"drive__torque_limit_{key}": value}) as joint, joint.opened() as drive, refusal(words):
        drive.commission()
    assert joint.downloads(*PLACE) == []


def test_a_drive_that_did_not_answer_gets_it_back_when_it_is_made_safe_again(
    epos: DeviceOnBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    with epos.commissioned() as drive:
        read = drive._objects.read

        def silent(index: int, *sub: int, what: str) -> int:
            if index == PLACE[0]:
                raise DeviceError("no answer")
            return read(index, *sub, what=what)

        with monkeypatch.context() as patched:
            patched.setattr(drive._objects, "read", silent)
            assert drive.make_safe() == "switch on disabled"
        assert epos.value(*PLACE) == 4958
        drive.make_safe()
    assert epos.value(*PLACE) == HELD


@pytest.mark.parametrize(
    ("code", "held", "reason"),
    [(READ_ONLY, HELD, "object is read only"), (OUT_OF_RANGE, HELD, "value out of range"), (READ_ONLY, 4958, "")],
)
def test_a_drive_that_does_not_let_it_be_written(epos: DeviceOnBus, code: int, held: int, reason: str) -> None:
    epos.store(*PLACE, held)
    epos.refused[PLACE] = code
    with epos.opened() as drive:
        if reason:
            with refusal(rf"writing 4958 to object 3001:2 \(torque limit\) .*{reason}"):
                drive.commission()
        else:
            assert "3001:2 (torque limit) cannot be written; it is 4958, as it must be" in drive.commission().remarks
        drive.make_safe()
    assert epos.value(*PLACE) == held


def test_one_that_reads_back_another_value_is_refused_and_set_back(epos: DeviceOnBus) -> None:
    epos.sequences[PLACE] = [HELD, 4950]
    with epos.opened() as drive, refusal(r"reads back 4950, 4958 was written"):
        drive.commission()
    assert epos.downloads(*PLACE) == [4958, HELD]


def test_a_drive_with_neither_is_refused_with_the_key(epos: DeviceOnBus) -> None:
    with epos.opened(torque_limit=None) as drive, refusal(r"no object 6072 \(max torque\)") as refused:
        drive.commission()
    assert "drive.torque_limit_object" in refused.value.hint


def test_a_drive_with_both_gets_both(tmp_path: Path) -> None:
    with joint_of(tmp_path, Listed(0x6072, 0, U16)) as joint, joint.opened() as drive:
        assert drive.commission().settings["max torque"].startswith("992 permille = 60.0 Nm, 3001:2 = 4958")
    assert joint.value(0x6072) == 992


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"torque_limit_object": "6040"}, r'torque_limit_object \(=6040\) must be an object of the maker, .*"6073"'),
        ({"torque_limit_object": "3001-2"}, r"torque_limit_object \(=3001-2\) must be an object of the maker"),
        ({"torque_limit_object": "1016:1"}, r"torque_limit_object \(=1016:1\) must be an object of the maker"),
        ({"torque_limit_rated_counts": 0}, r"torque_limit_rated_counts \(=0\) must be in \(0\.\.1e\+09\]"),
        ({"torque_limit_rated_counts": None}, "torque_limit_rated_counts must be given together"),
        ({"torque_limit_object": None}, "torque_limit_rated_counts must be given together"),
    ],
)
def test_what_the_keys_may_not_be(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        load_config(written(tmp_path / "joint.toml", **keys(**changes)))


def test_a_unit_that_nothing_would_be_compared_with_is_refused(tmp_path: Path) -> None:
    """A drive that counts mNm would have a thousandth of its rated torque, and be sent a thousand times as much."""
    with pytest.raises(ConfigurationError, match=r'rated_torque_unit \(="uNm"\) needs drive\.rated_torque_Nm'):
        joint_of(tmp_path, drive__rated_torque_Nm=None)


@pytest.mark.parametrize("unit", ["uNm", "mNm"])
def test_a_rated_torque_in_micronewton_metres(epos: DeviceOnBus, unit: str) -> None:
    assert epos.value(0x6076) == 500_000
    with epos.opened(rated_torque_unit=unit) as drive:
        if unit == "uNm":
            assert drive.commission().torque_resolution_Nm == pytest.approx(0.0605)
            return
        with refusal(r"rated_torque_Nm \(=0\.5\) does not agree with the drive's 500 Nm") as refused:
            drive.commission()
    assert 'drive.rated_torque_unit = "uNm"' in refused.value.hint
