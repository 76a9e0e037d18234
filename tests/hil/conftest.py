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

# files whose commands start as a user starts them; so do all with a terminal, and programs
ANEW = {"test_run_cli.py", "test_stop_and_clear.py", "test_demo.py", "test_scope_door.py"}


@pytest.fixture
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A new folder and bus; every process started through it is ended."""
    bench = Bench(tmp_path, anew=request.path.name in ANEW)
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
