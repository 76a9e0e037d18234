"""A `jointctl stop` that comes before a program with a `Joint` has its bus."""

from __future__ import annotations

import os
import re
import threading
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl import live_joint
from jointctl.drivers import stop_note
from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.errors import DeviceError, JointctlError, MotionFault
from jointctl.drivers.stop_note import now_ns, write_note
from jointctl.joint import Joint
from jointctl.program import Wanted, axes_of, wanted_source
from jointctl.tools.configuration.arm import SHIPPED_ARM
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.session.control import Control, StopSignals
from tests.configurations import written

pytestmark = pytest.mark.usefixtures("old_program")


@pytest.fixture
def old_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was started an hour ago, and the stops are another's."""
    for name, value in (("FOLDER", tmp_path), ("_asked_ns", None), ("_settled_ns", {})):
        monkeypatch.setattr(stop_note, name, value)
    monkeypatch.setattr(stop_note, "_began_ns", lambda: now_ns() - 3600 * 10**9)
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter(()))


@pytest.fixture
def joint_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def session(*_: object) -> None:
        raise AssertionError("it has begun")

    monkeypatch.setattr(live_joint, "Session", session)
    monkeypatch.setattr(live_joint, "load_check", lambda: None)
    return written(tmp_path / "joint.toml", "virtual", bus__channel=str(tmp_path / "no-one"))


def stop(path: Path) -> None:
    write_note(lock_name("jointctl", str(path.parent / "no-one")))


def test_it_counts_wherever_the_program_is(joint_file: Path) -> None:
    """A stop in the seconds before the `with` block said that the drive was off, and the joint moved afterwards."""
    joint = Joint(joint_file)
    stop(joint_file)
    with pytest.raises(MotionFault, match="stopped by jointctl stop before it began; nothing has moved"):
        joint.__enter__()
    with pytest.raises(AssertionError, match="it has begun"):  # once: its user knows of it by now
        Joint(joint_file).__enter__()
    stop(joint_file)
    with pytest.raises(MotionFault, match="stopped by jointctl stop before it began; nothing has moved"):
        Joint(joint_file).__enter__()


@pytest.mark.parametrize("before", [True, False])
def test_a_stop_of_its_own_is_one_of_what_it_has_asked_for_before(
    joint_file: Path, monkeypatch: pytest.MonkeyPatch, before: bool
) -> None:
    monkeypatch.setattr(stop_note, "_ancestors", lambda: iter((os.getpid(),)))
    joint = None if before else Joint(joint_file)
    stop(joint_file)
    with pytest.raises(AssertionError if before else MotionFault):
        (joint or Joint(joint_file)).__enter__()


@pytest.mark.parametrize("given", ["virtual.toml", Path("virtual.toml"), load_config])
def test_where_its_files_are_does_not_change_with_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: Any
) -> None:
    """The virtual joint would be that of another file of this name, such as the shipped one."""
    written(tmp_path / "virtual.toml", "virtual")
    monkeypatch.chdir(tmp_path)
    source, _ = wanted_source(given("virtual.toml") if callable(given) else given, "Joint", Wanted(virtual=True))
    monkeypatch.chdir("/")
    assert (source.config.path, axes_of(source.config).joints[0].log.folder) == (
        tmp_path / "virtual.toml", str(tmp_path / "runs"),
    )  # fmt: skip
    assert source.own_virtual


def test_so_it_is_of_an_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copytree(SHIPPED_ARM.parent, tmp_path / "arm")
    monkeypatch.chdir(tmp_path)
    source, _ = wanted_source(Path("arm", SHIPPED_ARM.name), "Arm", Wanted(virtual=True))
    joints = axes_of(source.config).joints
    assert source.config.path == tmp_path / "arm" / SHIPPED_ARM.name
    assert {joint.path.parent for joint in joints} == {tmp_path / "arm"}
    assert {joint.log.folder for joint in joints} == {str(tmp_path / "runs")}


@pytest.mark.parametrize(("given", "kind"), [("virtual", "Joint"), ("arm", "Arm")])
@pytest.mark.parametrize(("virtual", "bitrate_bitps"), [(True, 1_000_000), (False, 500_000)])
def test_virtual_drives_of_ones_own_do_not_follow_the_environment(
    monkeypatch: pytest.MonkeyPatch, given: str, kind: str, virtual: bool, bitrate_bitps: int
) -> None:
    """Those of an arm did, whose bus was then too slow for its joints."""
    monkeypatch.setenv("CAN_BITRATE", "500000")
    path = {"arm": SHIPPED_ARM}.get(given, shipped_config("virtual"))
    source, _ = wanted_source(path, kind, Wanted(place=("socketcan", "can0", None, None, None), virtual=virtual))
    assert {joint.bus.bitrate_bitps for joint in axes_of(source.config).joints} == {bitrate_bitps}


def live_motor(**parts: Any) -> Any:
    """One with nothing but these parts."""
    motor: Any = live_joint.LiveMotor.__new__(live_joint.LiveMotor)
    vars(motor).update(parts)
    return motor


@pytest.mark.parametrize("by", ["", "jointctl stop"])
def test_a_fault_that_comes_with_a_stop_names_it(by: str) -> None:
    """A stop switches the drive off at once: the loop may see that before it has read the request."""
    ended = SimpleNamespace(motion_fault=lambda: MotionFault("DRIVE_NOT_ENABLED (9): it is off", "check the wiring"))
    result = SimpleNamespace(faulty=[ended], stopped_by=by)
    motor = live_motor(_process=os.getpid(), _over=True, _error=None, result=result)
    with pytest.raises(MotionFault) as raised:
        motor._raise()
    assert raised.value.message == "DRIVE_NOT_ENABLED (9): it is off" + (f"; stopped by {by}" if by else "")
    assert raised.value.hint == "check the wiring"


@pytest.mark.parametrize(
    ("state", "raised"),
    [
        ("switch on disabled", (MotionFault, "the run has ended, by jointctl stop; the joint is off")),
        ("unknown: no answer", (DeviceError, "the drive did not confirm that it is off (=unknown: no answer)")),
    ],
)
def test_after_a_stop_the_joint_is_called_off_only_where_its_drive_has_confirmed_it(
    state: str, raised: tuple[type[JointctlError], str]
) -> None:
    result, session = SimpleNamespace(faulty=[], stopped_by="jointctl stop"), SimpleNamespace(drive_state=state)
    motor = live_motor(_process=os.getpid(), _over=True, _error=None, _control=None, result=result, _session=session)
    kind, text = raised
    with pytest.raises(kind, match=re.escape(text)):
        motor._raise()


def test_a_session_is_over_even_where_its_bus_cannot_be_given_back() -> None:
    """`stop` waits for it."""

    def close() -> None:
        raise OSError("no such file")

    session, bus = SimpleNamespace(run=lambda: "done"), SimpleNamespace(close=close)
    motor = live_motor(_over=False, _session=session, _bus=bus)
    with pytest.raises(OSError, match="no such file"):
        motor._run()
    assert (motor._over, motor.result) == (True, "done")


def test_a_session_whose_start_was_interrupted_finds_that_it_is_to_end() -> None:
    """Python may be interrupted in `Thread.start` with the thread on its way, not yet known by its number."""
    control = Control(StopSignals(wake=lambda: None))
    motor = live_motor(_over=False, _thread=threading.Thread(), _control=control)
    motor._end()
    with pytest.raises(KeyboardInterrupt):
        motor._control.signals.leave_if_asked()  # before anything is sent
