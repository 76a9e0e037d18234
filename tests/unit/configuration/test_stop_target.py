"""`jointctl stop` needs an address and nothing else: no defect elsewhere in the configuration costs the stop."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config
from jointctl.tools.verbs.bench_drive import stop_target
from jointctl.tools.verbs.canopen_bench import CanTarget
from jointctl.tools.verbs.elmo_bench import PortTarget
from tests.configurations import edited_file
from tests.places import CONFIGS

NOTHING: dict[str, str] = {}


def test_the_mark_that_an_editor_begins_a_file_with_does_not_matter(tmp_path: Path) -> None:
    path = edited_file(tmp_path, ("[control]", "[contr"))
    text = path.read_text()
    path.write_text("\ufeff" + text[text.index("[bus]") :], encoding="utf-8")
    assert stop_target(path, environ=NOTHING) == stop_target(CONFIGS / "virtual.toml", environ=NOTHING)


@pytest.mark.parametrize(
    "changes",
    [
        (),
        (("[control]", "[control]\nkp = -3"),),
        (("[control]", "[control]\nkp ="),),  # saved in the middle of a word: no TOML as a whole
        (("[control]", "[contr"),),
        (("[bus]", "[bus]\nnoise ="),),
        (("[joint]", "[jiont]"),),
        (("virtual_joint.eds", "no_such.eds"),),
    ],
)
def test_what_is_wrong_elsewhere_does_not_matter(tmp_path: Path, changes: tuple[tuple[str, str], ...]) -> None:
    path = edited_file(tmp_path, *changes)
    if changes:
        with pytest.raises(ConfigurationError):
            load_config(path)
    shipped = load_config(CONFIGS / "virtual.toml")
    assert stop_target(path, environ=NOTHING) == CanTarget(
        shipped.bus.interface, shipped.bus.channel, None, canopen_section(shipped).node,
        braking_s=shipped.sequence.stop_timeout_s, off_s=shipped.sequence.off_timeout_s,
    )  # fmt: skip


@pytest.mark.parametrize(("text", "braking_s"), [("12.5", 12.5), ("60.0", 60.0), ("61.0", None), ('"3"', None)])
def test_how_long_it_may_brake_is_that_of_the_file_if_it_can_be_right(
    tmp_path: Path, text: str, braking_s: float | None
) -> None:
    path = edited_file(tmp_path, ("\nstop_timeout_s = 3.0", f"\nstop_timeout_s = {text}"))
    target = stop_target(path, environ=NOTHING)
    assert isinstance(target, CanTarget)
    assert target.braking_s == braking_s


@pytest.mark.parametrize("changes", [(), (("[control]", "[control]\nkp ="),), (("\n[limits]", "\n[limts]"),)])
def test_the_same_on_a_serial_line(tmp_path: Path, changes: tuple[tuple[str, str], ...]) -> None:
    path = edited_file(tmp_path, *changes, base="elmo_serial")
    drive: Any = load_config(CONFIGS / "elmo_serial.toml").drive
    expected = PortTarget(drive.port, drive.baud_rate_bitps, drive.reply_timeout_s)
    assert stop_target(path, environ=NOTHING) == expected
    other = stop_target(path, GivenPlace(port="/dev/ttyUSB9"), NOTHING)
    assert other == PortTarget("/dev/ttyUSB9", drive.baud_rate_bitps, drive.reply_timeout_s)


@pytest.mark.parametrize("node", ["0", "128", "true", '"1"', "1.5"])
def test_a_node_that_is_none_is_told_and_can_be_given(tmp_path: Path, node: str) -> None:
    path = edited_file(tmp_path, ("\nnode = 1\n", f"\nnode = {node}\n"))
    with pytest.raises(ConfigurationError, match=r"drive.node \(=.*\) must be in \[1..127\] \(it can be given"):
        stop_target(path, environ=NOTHING)
    target = stop_target(path, GivenPlace(node=1), NOTHING)
    assert isinstance(target, CanTarget)
    assert target.node == 1


def test_without_any_file_the_command_line_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "gone.toml"
    given = {"interface": "socketcan", "channel": "can0", "node": 7}
    assert stop_target(path, GivenPlace(**given), NOTHING) == CanTarget("socketcan", "can0", None, 7)  # type: ignore[arg-type]
    for left_out in given:
        less: Any = {key: value for key, value in given.items() if key != left_out}
        with pytest.raises(ConfigurationError, match=f"cannot be read.*{left_out} is missing"):
            stop_target(path, GivenPlace(**less), NOTHING)


def test_flag_beats_environment_beats_file(tmp_path: Path) -> None:
    path = edited_file(tmp_path)
    sequence = load_config(path).sequence
    expected = partial(CanTarget, braking_s=sequence.stop_timeout_s, off_s=sequence.off_timeout_s)
    environ = {"CAN_INTERFACE": "slcan", "CAN_CHANNEL": "/dev/ttyACM0", "CAN_BITRATE": "250000"}
    assert stop_target(path, environ=environ) == expected("slcan", "/dev/ttyACM0", 250_000, 1)
    assert stop_target(path, GivenPlace(channel="x", bitrate=125_000), environ) == expected("slcan", "x", 125_000, 1)
    file_rate = load_config(path).bus.bitrate_bitps
    assert stop_target(path, environ={**environ, "CAN_BITRATE": "fast"}) == expected(
        "slcan", "/dev/ttyACM0", file_rate, 1
    )


def test_an_encoder_node_is_told_as_well(tmp_path: Path) -> None:
    path = edited_file(tmp_path, ("[joint]", '[joint_encoder]\nsource = "node"\nnode = 2\n\n[joint]'))
    target = stop_target(path, environ=NOTHING)
    assert isinstance(target, CanTarget)
    assert target.encoder_node == 2


@pytest.mark.parametrize(
    ("base", "given", "words"),
    [
        ("elmo_serial", GivenPlace(channel="can0"), "the drive is on a serial port: use -p"),
        ("virtual", GivenPlace(port="/dev/ttyUSB7"), r"drive.kind \(=canopen\) must be \"elmo_serial\""),
    ],
)
def test_options_of_the_other_kind_are_refused(tmp_path: Path, base: str, given: GivenPlace, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        stop_target(edited_file(tmp_path, base=base), given, NOTHING)
