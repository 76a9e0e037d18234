"""A `jointctl stop` that comes before a program with a `Joint` has its bus."""

from __future__ import annotations

from pathlib import Path

import pytest

from jointctl import live_joint
from jointctl.drivers import stop_note
from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.errors import MotionFault
from jointctl.drivers.stop_note import now_ns, write_note
from jointctl.joint import Joint
from tests.configurations import written

pytestmark = pytest.mark.usefixtures("old_program")


@pytest.fixture
def old_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was started an hour ago, and the stops are another's."""
    monkeypatch.setattr(stop_note, "FOLDER", tmp_path)
    monkeypatch.setattr(stop_note, "_asked_ns", None)
    monkeypatch.setattr(stop_note, "_by_hand", False)
    monkeypatch.setattr(stop_note, "_served", set())
    monkeypatch.setattr(stop_note, "_started_ns", lambda: now_ns() - 3600 * 10**9)
    monkeypatch.setattr(stop_note, "_ancestors", lambda _: iter(()))


@pytest.fixture
def joint_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def session(*_: object) -> None:
        raise AssertionError("it has begun")

    monkeypatch.setattr(live_joint, "Session", session)
    monkeypatch.setattr(live_joint, "load_check", lambda: None)
    return written(tmp_path / "joint.toml", "virtual", bus__channel=str(tmp_path / "no-one"))


def stop(path: Path) -> None:
    write_note(lock_name("jointctl", str(path.parent / "no-one")))


def test_it_counts_from_the_line_with_the_joint_on_while_that_loads(
    joint_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop in the seconds before the `with` block said that the drive was off, and the joint moved afterwards."""
    from jointctl import program

    load = program.wanted_source
    monkeypatch.setattr(program, "wanted_source", lambda *given: (stop(joint_file), load(*given))[1])
    joint = Joint(joint_file)
    monkeypatch.setattr(program, "wanted_source", load)
    Joint(joint_file)  # of the same program, and later: each counts by its own line
    with pytest.raises(MotionFault, match="stopped by jointctl stop before it began; nothing has moved"):
        joint.__enter__()


def test_its_twin_one_that_came_before_is_another_matter(joint_file: Path) -> None:
    stop(joint_file)
    with pytest.raises(AssertionError, match="it has begun"):
        Joint(joint_file).__enter__()
