"""What a run on hardware loads: nothing of the virtual joint."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from jointctl.hil.faults import LOCKSTEP_ONLY, FaultKind
from jointctl.hil.faults import MAX_FAULTS as MAX_FAULTS_OF_THE_JOINT
from jointctl.tools.configuration.sections import FAULT_KINDS, MAX_FAULTS
from tests.places import CONFIGS

SUPERVISOR = """
import json, sys
from contextlib import suppress
from pathlib import Path
from jointctl.drivers.errors import BusError
from jointctl.tools.verbs import main, start
from jointctl.tools.configuration.load import load_config
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.session.loops import loop_of
from jointctl.tools.session.plan import resolve
from jointctl.tools.verbs.run import run
config = load_config(Path(sys.argv[1]))
resolve(config)
drive = session_drive(config.drive.kind)
drive.check_rate(config)
loop_of(config.drive.kind)
with suppress(BusError):  # there is no such interface
    drive.open(config)
print(json.dumps(sorted(sys.modules)))
"""
LOOP = """
import json, sys
from jointctl.tools.session import loop_process, loops
from jointctl.tools.session.loop_memory import SharedBlock
from jointctl.drivers.canopen import exchange
from jointctl.drivers.canopen.cyclic import CanopenPort
loops.compiled_call(SharedBlock.create(1, CanopenPort), 1_000_000, 0)
print(json.dumps(sorted(sys.modules)))
"""


COMPILED = """
import json, sys
from jointctl.tools.session.loops import warm_up_compiled_loop
warm_up_compiled_loop()
print(json.dumps(sorted(sys.modules)))
"""


def test_a_loop_that_was_compiled_once_is_loaded_without_the_compiler() -> None:
    command = [sys.executable, "-P", "-c", COMPILED]
    for _ in range(2):
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert "jointctl.firmware_py.cycle" in found
    assert [
        name for name in ("numba", "scipy", "pydantic", "can", "jointctl.firmware_py.compiler") if name in found
    ] == []


@pytest.mark.parametrize("program", [SUPERVISOR, LOOP], ids=["supervisor", "loop"])
def test_a_canopen_run_on_hardware_loads_nothing_of_the_virtual_joint_and_of_elmo(tmp_path: Path, program: str) -> None:
    text = (CONFIGS / "virtual.toml").read_text().replace('"jointctl"', '"socketcan"', 1)
    head, _, rest = text.partition("[virtual]")
    path = tmp_path / "joint.toml"
    path.write_text(head + rest[rest.index("[log]") :])
    command = [sys.executable, "-P", "-c", program, str(path)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert "jointctl.drivers.canopen.cyclic" in found
    assert [name for name in found if name.startswith("jointctl.hil") or "elmo" in name] == []


def test_the_section_knows_the_faults_of_the_joint() -> None:
    """By their names only: the configuration of a run on hardware does not load them."""
    mine = tuple(kind.name.lower() for kind in FaultKind if kind not in (FaultKind.NONE, *LOCKSTEP_ONLY))
    assert mine == FAULT_KINDS
    assert MAX_FAULTS == MAX_FAULTS_OF_THE_JOINT
