"""The benches: a folder and a bus, and a serial line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jointctl.tools.configuration.load import load_config
from tests.hil.bench import Bench
from tests.hil.serial_bench import SerialBench, end_line_guards, name_kept
from tests.places import CONFIGS
from tests.real_time_joint import real_time_serial_joint


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A new folder and bus; every process started through it is ended."""
    bench = Bench(tmp_path)
    yield bench
    bench.end()


@pytest.fixture
def serial_bench(bench: Any) -> Iterator[SerialBench]:
    found = SerialBench(bench)
    (bench.folder / "device.toml").write_text((CONFIGS / "elmo_serial.toml").read_text())
    with real_time_serial_joint(load_config(bench.folder / "device.toml")) as device:
        found.device = device
        with name_kept(device.path):
            try:
                yield found
            finally:
                bench.end()  # a run that is killed after its port has gone leaves a guard behind
                end_line_guards(device.path)
