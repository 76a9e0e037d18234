"""What `jointctl stop` knows of a program with a `Joint` that does not control its bus yet."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import jointctl
from jointctl.drivers.bus_lock import STARTING, is_marked, no_longer_starting
from jointctl.drivers.errors import ConfigurationError
from jointctl.joint import Joint
from tests.configurations import written


@pytest.fixture(autouse=True)
def _unmarked() -> Iterator[None]:
    yield
    no_longer_starting()


def starts() -> bool:
    return is_marked(os.getpid(), STARTING)


def test_it_is_waited_for_from_its_first_line_on_while_it_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop in the seconds before the `with` block said that the drive was off, and the joint moved afterwards."""
    from jointctl import program

    load, seen = program.wanted_source, []
    monkeypatch.setattr(program, "wanted_source", lambda *given: (seen.append(starts()), load(*given))[1])
    assert not starts()
    Joint(written(tmp_path / "joint.toml", "virtual", bus__channel="no-one"))
    assert seen == [True]
    assert starts()  # until it has its bus


@pytest.mark.parametrize("how", [{"lockstep": True}, {"virtual": True}])
def test_its_twin_one_that_no_stop_is_for_is_not(how: dict[str, bool]) -> None:
    Joint("virtual", **how)  # type: ignore[arg-type]
    assert not starts()


def test_nor_one_that_is_refused() -> None:
    with pytest.raises(ConfigurationError):
        jointctl.Joint("no_such.toml")
    assert not starts()
