"""Opening the drive of a configuration: what fails leaves the bus to the next one that tries."""

from __future__ import annotations

from pathlib import Path

import pytest

from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.load import load_config
from jointctl.tools.output import Output
from jointctl.tools.session.control import in_control
from jointctl.tools.session.open_drive import open_drive
from tests.places import CONFIGS


def test_a_bus_that_cannot_be_opened_can_be_tried_again(tmp_path: Path) -> None:
    text = (CONFIGS / "virtual.toml").read_text().replace('"virtual0"', f'"{tmp_path}/none.sock"')
    (tmp_path / "joint.toml").write_text(text)
    config = load_config(tmp_path / "joint.toml")
    for _ in range(2):
        with in_control(config, Output()), pytest.raises(BusError, match="no virtual bus at"):
            open_drive(config)
