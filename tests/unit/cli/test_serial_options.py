"""What each verb does with `-p PORT`, and with options and configurations of the other kind of drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.cli.main import app
from jointctl.tools.cli.options import BusOptions, CanOptions, loaded
from jointctl.tools.configuration.elmo_settings import elmo_section

SERIAL, CAN = Path("elmo_serial"), Path("virtual")


@pytest.mark.parametrize("verb", ["doctor", "info", "monitor", "sweep", "run", "stop", "clear-fault"])
def test_these_verbs_take_a_port(verb: str) -> None:
    commands: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert "-p" in [name for parameter in commands[verb].params for name in parameter.opts]


def test_the_port_replaces_the_one_of_the_file() -> None:
    assert elmo_section(loaded(SERIAL, BusOptions(port="/dev/ttyUSB7"))).port == "/dev/ttyUSB7"
    assert loaded(CAN, CanOptions(target=9)).canopen.node == 9


@pytest.mark.parametrize(
    ("path", "options", "words"),
    [
        (SERIAL, {"interface": "socketcan"}, "socketcan names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"channel": "can0"}, "can0 names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"bitrate": 500_000}, "500000 names a CAN bus, the drive is on a serial port: use -p"),
        (SERIAL, {"target": 3}, 'drive.kind (=elmo_serial) must be "canopen" here'),
        (CAN, {"port": "/dev/ttyUSB7"}, 'drive.kind (=canopen) must be "elmo_serial" for a serial port'),
    ],
)
def test_options_of_the_other_kind_are_refused(path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        loaded(path, BusOptions(**options))
    assert words in caught.value.message


def refused_by_hil(*arguments: str) -> str:
    error = CliRunner().invoke(app, ["hil", *arguments]).exception
    assert isinstance(error, ConfigurationError)
    return error.message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("elmo_serial", "-p", "/dev/ttyUSB0"), "--port (=/dev/ttyUSB0) must be absent for hil"),
        (("elmo_serial", "--timing"), "--timing is for a CAN bus"),
        (("elmo_serial", "-c", "vcan"), "vcan names a CAN bus"),
        (("paper", "--serial"), 'drive.kind (=canopen) must be "elmo_serial"'),
        (("virtual", "--link", "tty"), 'drive.kind (=canopen) must be "elmo_serial"'),
    ],
)
def test_hil_refuses_what_it_would_not_do(arguments: tuple[str, ...], words: str) -> None:
    assert words in refused_by_hil(*arguments)


def test_its_twin_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[Any] = []

    def stand_in(config: Any, _: Any, **options: Any) -> int:
        served.append((config.drive.kind, options))
        return 0

    monkeypatch.setattr("jointctl.tools.verbs.hil_serial.hil_serial", stand_in)
    assert CliRunner().invoke(app, ["hil", "--serial", "--link", "tty"]).exit_code == 0
    assert served == [("elmo_serial", {"link": "tty", "ready_fd": None})]
