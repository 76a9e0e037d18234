"""`jointctl new` with a drive: what it says is taken, the rest is asked for, nothing is made up."""

from __future__ import annotations

import dataclasses
import errno
import io
import os
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, NoDeviceError, UsageError
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.load import load_config, read_text, shipped_config
from jointctl.tools.inspection.first_files import checked, eds_of_identity, filled, first_values, marks
from jointctl.tools.inspection.subject import SdoReader, Subject, canopen_network
from jointctl.tools.output import Output
from jointctl.tools.verbs.new import DriveOptions, new
from tests.device_on_bus import DeviceOnBus
from tests.eds_styles import GOLD, NANOTEC, eds_text
from tests.places import EDS
from tests.sessions import output

TEMPLATE = read_text(shipped_config("elmo_gold_can"))
ANSWERS = {
    "drive.eds": "mine.eds", "drive.torque_reference": "rated_torque", "drive.torque_direction": "",
    "encoder.side": "", "encoder.direction": "", "encoder.zero_counts": "100", "joint.reduction_ratio": "",
    "joint.inertia_kgm2": "20000 kg cm2", "joint.torque_constant_NmpA": "", "joint.torque_constant_ampere": "",
    "limits.position_min_rad": "-20 deg", "limits.position_max_rad": "x\n-21 deg\n20 deg", "limits.torque_max_Nm": "20",
}  # fmt: skip


@pytest.fixture
def drive(joint: DeviceOnBus) -> DriveOptions:
    return DriveOptions("virtual", joint.channel, 1_000_000, 1)


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, str]], None]:
    """A terminal at which the questions are answered by their keys, in the order of the template."""

    def at(answers: dict[str, str]) -> None:
        text = "".join(
            f"{answers[f'{m.section}.{m.key}']}\n" for m in marks(TEMPLATE) if f"{m.section}.{m.key}" in answers
        )
        stdin = io.StringIO(text)
        stdin.isatty = lambda: True  # type: ignore[method-assign]
        monkeypatch.setattr(sys, "stdin", stdin)

    return at


def test_what_the_drive_says_is_taken_and_the_rest_asked_for(
    tmp_path: Path, drive: DriveOptions, typed: Callable[[dict[str, str]], None], joint: DeviceOnBus
) -> None:
    (tmp_path / "mine.eds").write_text(EDS.read_text())
    typed({key: answer for key, answer in ANSWERS.items() if key != "drive.eds"})
    said, _, err = output()
    assert new(tmp_path / "mine.toml", said, drive=drive) == 0
    config = load_config(tmp_path / "mine.toml")
    section = canopen_section(config)
    assert (section.node, section.eds, section.vendor_id, section.product_code) == (1, "mine.eds", 0, 1)
    assert (section.rated_current_A, section.rated_torque_Nm) == (5.0, 0.5)
    assert (config.encoder.counts_per_turn, config.encoder.side, config.encoder.zero_counts) == (524288, "joint", 100)
    assert (config.joint.reduction_ratio, config.joint.torque_constant_NmpA) == (121.0, pytest.approx(0.1))
    assert config.joint.inertia_kgm2 == pytest.approx(2.0)
    assert config.limits.position_max_rad == pytest.approx(0.349066, abs=1e-6)
    text = err.getvalue()
    assert "20 deg is read as 0.349066 rad" in text
    assert "limits.position_max_rad (=x)" in text
    assert "limits.position_min_rad (=-0.349066) must be less than limits.position_max_rad (=-0.366519)" in text
    assert "drive.rated_current_A = 5.0 (6075)" in text
    assert "FILL IN: " not in (tmp_path / "mine.toml").read_text()
    assert {data[0] & 0xE0 for identifier, data in joint.requests if identifier == 0x601} <= {0x40, 0x60}


def test_no_input_takes_what_the_drive_says_and_leaves_the_rest_marked(tmp_path: Path, drive: DriveOptions) -> None:
    said, _, err = output()
    assert new(tmp_path / "mine.toml", said, drive=drive, no_input=True) == 0
    text = (tmp_path / "mine.toml").read_text()
    data = tomllib.loads(text)
    assert data["drive"]["node"] == 1
    assert data["encoder"] == {"counts_per_turn": 524288}
    assert "inertia_kgm2" not in data["joint"]
    left = {f"{m.section}.{m.key}" for m in marks(text)}
    assert left == set(ANSWERS)
    assert "no EDS file for this drive" in err.getvalue()
    assert f"the {text.count('FILL IN: ')} values marked" in err.getvalue()
    with pytest.raises(ConfigurationError, match="missing"):
        load_config(tmp_path / "mine.toml")


def test_a_dash_or_the_end_of_the_input_leaves_a_value_open(
    tmp_path: Path, drive: DriveOptions, typed: Callable[[dict[str, str]], None]
) -> None:
    typed(dict.fromkeys(list(ANSWERS)[:5], "-"))
    new(tmp_path / "mine.toml", output()[0], drive=drive)
    assert {f"{m.section}.{m.key}" for m in marks((tmp_path / "mine.toml").read_text())} == set(ANSWERS)


def test_no_terminal_and_no_answer_are_named(tmp_path: Path, drive: DriveOptions) -> None:
    with pytest.raises(UsageError, match="no terminal"):
        new(tmp_path / "mine.toml", output()[0], drive=drive)
    with pytest.raises(ConfigurationError, match="which node"):
        new(tmp_path / "mine.toml", output()[0], drive=dataclasses.replace(drive, node=None))
    with pytest.raises(NoDeviceError, match="node 9"):
        new(tmp_path / "mine.toml", output()[0], drive=dataclasses.replace(drive, node=9), no_input=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"), [("mine.toml", "exists already"), ("none/mine.toml", "cannot be written: No such file")]
)
def test_a_file_that_cannot_be_made_is_refused_before_the_drive_is_asked(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "mine.toml").write_text("mine")
    with pytest.raises(DataError, match=words):
        new(tmp_path / name, output()[0], drive=DriveOptions("none", "none", None, 1))


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("stop", "raised"), [(FULL, DataError), (KeyboardInterrupt(), KeyboardInterrupt)])
@pytest.mark.parametrize("arm", [False, True])
def test_nothing_is_left_of_files_whose_writing_ends_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arm: bool, stop: BaseException, raised: type[BaseException]
) -> None:
    def fsync(_: int) -> None:
        raise stop

    def write_bytes(path: Path, content: bytes) -> int:
        path.touch()
        if path.suffix == ".urdf":  # the second of the files
            raise stop
        return len(content)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    with pytest.raises(raised, match="cannot be written: No space left" if raised is DataError else None):
        new(tmp_path / ("mine" if arm else "mine.toml"), output()[0], arm=arm)
    assert list(tmp_path.iterdir()) == []


def test_the_next_command_can_be_copied_where_a_folder_has_blanks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new(tmp_path / "my arm", Output(), arm=True)
    new(tmp_path / "my joint.toml", Output())
    said = capsys.readouterr().err
    assert f"jointctl check '{tmp_path / 'my arm' / 'arm.toml'}'" in said
    assert f"jointctl doctor '{tmp_path / 'my joint.toml'}'" in said


def test_nothing_takes_the_place_of_a_link_that_leads_nowhere(tmp_path: Path) -> None:
    for name, arm in (("mine.toml", False), ("mine", True)):
        (tmp_path / name).symlink_to(tmp_path / "none")
        with pytest.raises(DataError, match="exists already"):
            new(tmp_path / name, output()[0], arm=arm)
    assert not (tmp_path / "none").exists()


class Inverting(SdoReader):
    """With an object 607E, which the virtual drive lacks."""

    def value(self, index: int, sub: int = 0) -> Any:
        return 0xC0 if index == 0x607E else super().value(index, sub)


class Scaling(SdoReader):
    """With an object 6092, which the virtual drive lacks."""

    feed = (0, 0)

    def value(self, index: int, sub: int = 0) -> Any:
        return self.feed[sub - 1] if index == 0x6092 else super().value(index, sub)


def reader_of(joint: DeviceOnBus) -> Any:
    return canopen_network(Subject("virtual", joint.channel, None, 1))


def test_limits_and_polarity_of_the_drive(tmp_path: Path, joint: DeviceOnBus) -> None:
    zero = joint.device.objects.value(0x6064, 0)
    joint.answers |= {(0x607D, 1): zero - 83443, (0x607D, 2): zero + 83443, (0x6080, 0): 200}
    with reader_of(joint) as network:
        found = first_values(Inverting(network, 1), tmp_path)
    assert found.suggested["limits", "position_max_rad"][0] == pytest.approx(1.0, abs=1e-3)
    assert found.suggested["limits", "position_min_rad"][0] == pytest.approx(-1.0, abs=1e-3)
    assert found.known["limits", "velocity_max_radps"][0] == pytest.approx(0.173, abs=1e-3)
    assert any("607E (polarity) is C0h" in remark for remark in found.remarks)


@pytest.mark.parametrize(("speed_rpm", "taken"), [(577, True), (579, False)])
def test_a_speed_is_never_wider_than_the_templates(
    tmp_path: Path, joint: DeviceOnBus, speed_rpm: int, taken: bool
) -> None:
    joint.answers[0x6080, 0] = speed_rpm
    with reader_of(joint) as network:
        found = first_values(SdoReader(network, 1), tmp_path)
    assert (("limits", "velocity_max_radps") in found.known) is taken


@pytest.mark.parametrize(
    ("counts", "turns", "side", "per_turn", "ratio"),
    [(4096, 1, "motor", 4096, None), (409600, 100, "motor", 4096, None), (524288, 121, "joint", 524288, 121.0)],
)
def test_whose_turns_608f_counts(
    tmp_path: Path, joint: DeviceOnBus, counts: int, turns: int, side: str, per_turn: int, ratio: float | None
) -> None:
    joint.answers |= {(0x608F, 1): counts, (0x608F, 2): turns}
    with reader_of(joint) as network:
        found = first_values(SdoReader(network, 1), tmp_path)
    assert found.known["encoder", "counts_per_turn"][0] == per_turn
    assert found.suggested["encoder", "side"][0] == side
    assert found.suggested.get(("joint", "reduction_ratio"), (None,))[0] == ratio


@pytest.mark.parametrize(
    ("feed", "shaft_turns", "taken", "suggested"),
    [(360_000, 1, None, 360_000), (720_000, 2, None, 360_000), (1, 1, None, None), (8192, 2, 4096, None),
     (0, 0, 4096, None)],
)  # fmt: skip
def test_counts_of_the_encoder_are_not_taken_where_the_drive_scales_its_position(
    tmp_path: Path, joint: DeviceOnBus, feed: int, shaft_turns: int, taken: int | None, suggested: int | None
) -> None:
    joint.answers |= {(0x608F, 1): 4096, (0x608F, 2): 1}
    with reader_of(joint) as network:
        reader = Scaling(network, 1)
        reader.feed = (feed, shaft_turns)
        found = first_values(reader, tmp_path)
    place = "encoder", "counts_per_turn"
    assert (found.known.get(place, (None,))[0], found.suggested.get(place, (None,))[0]) == (taken, suggested)
    assert any("6092 is" in remark for remark in found.remarks) is (taken is None)


def test_the_eds_by_identity(tmp_path: Path) -> None:
    assert eds_of_identity(tmp_path, 1, 0x9A, 16)[0] is None
    (tmp_path / "gold.EDS").write_text(eds_text(GOLD))
    (tmp_path / "nanotec.eds").write_text(eds_text(NANOTEC))
    (tmp_path / "broken.eds").write_text("nothing")
    assert eds_of_identity(tmp_path, 1, 0x9A, 16)[0] == tmp_path / "gold.EDS"
    path, remark = eds_of_identity(tmp_path, 1, 0x26C, 17)
    assert (path, "another product: nanotec.eds" in remark) == (None, True)
    (tmp_path / "newer.eds").write_text(eds_text(GOLD))
    path, remark = eds_of_identity(tmp_path, 1, 0x9A, 16)
    assert (path, "gold.EDS, newer.eds: which one?" in remark) == (None, True)


def test_every_marked_line_can_be_filled_and_checked() -> None:
    samples = dict(re.findall(r"^# (\w+) = (\S+) .*# FILL IN", TEMPLATE, re.M))
    values = {m.place: checked(m.place, samples[m.key])[0] for m in marks(TEMPLATE)}
    text = filled(TEMPLATE, values)
    assert marks(text) == []
    data = tomllib.loads(text)
    assert all(data[section][key] == value for (section, key), value in values.items())


@pytest.mark.parametrize(
    ("place", "text"),
    [(("encoder", "direction"), "2"), (("encoder", "side"), "shaft"), (("limits", "torque_max_Nm"), "-1"),
     (("encoder", "counts_per_turn"), "4096.5"), (("drive", "node"), "128"), (("joint", "inertia_kgm2"), "nan"),
     *((("limits", "torque_max_Nm"), digits * "9") for digits in (400, 5000))],
)  # fmt: skip
def test_an_answer_that_may_not_be_is_refused_by_name(place: tuple[str, str], text: str) -> None:
    with pytest.raises(ValueError, match=rf"{place[0]}\.{place[1]} \(={re.escape(text)}\) "):
        checked(place, text)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("0,5", "; with a decimal point: 0.5"), ("-,5", "; with a decimal point: -0.5"),
        ("1,25 kg cm2", "; with a decimal point: 1.25 kg cm2"), ("1,2,3", ""),  # the twin is a list
    ],
)  # fmt: skip
def test_a_decimal_comma_is_answered_with_the_point(text: str, hint: str) -> None:
    with pytest.raises(ValueError, match=rf"should be a valid number{hint}$"):
        checked(("joint", "inertia_kgm2"), text)


@pytest.mark.parametrize("maxon", [True, False])
def test_what_an_epos4_counts_in_and_lacks_is_said(tmp_path: Path, joint: DeviceOnBus, maxon: bool) -> None:
    assert joint.device is not None
    if maxon:
        joint.answers |= {(0x1018, 1): 0xFB, (0x6076, 0): 66_500}
        del joint.device.objects.entries[0x6072, 0]
    with reader_of(joint) as network:
        found = first_values(SdoReader(network, 1), tmp_path)
    assert found.known["drive", "rated_torque_Nm"][0] == pytest.approx(0.0665 if maxon else 0.5)
    for words in ('rated_torque_unit = "uNm"', "no 6072 (max torque): name the maker's own limit"):
        assert any(words in remark for remark in found.remarks) is maxon


def test_a_file_of_ones_own_is_copied_by_a_relative_path_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was looked for among the shipped ones, unless its path was absolute."""
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own.toml"
    own.write_text("# mine\n")
    for k, name in enumerate(("own.toml", "./own.toml", str(own))):
        new(Path(f"copy{k}.toml"), output()[0], shipped=name)
        assert Path(f"copy{k}.toml").read_text() == "# mine\n"
    with pytest.raises(ConfigurationError, match="no such file"):
        new(Path("copy.toml"), output()[0], shipped="none_such")
