"""`excite` on the virtual joint in simulated time: what its log tells `identify` is what the joint truly has."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import pytest

from jointctl.drivers.errors import UsageError
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.motion_fit import identify_motion
from jointctl.tools.identification.tables import ForeignFormat
from jointctl.tools.output import Output
from jointctl.tools.verbs.excite import ExciteOptions, excite
from jointctl.tools.verbs.identify import motion_from
from tests.configurations import written

PENDULUM = {
    "joint__gravity_Nm": 20.0, "virtual__gravity_Nm": 20.0, "limits__position_min_rad": -1.5,
    "limits__position_max_rad": 1.5,
}  # fmt: skip


def test_the_log_of_the_motion_tells_inertia_gravity_and_friction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load_config(written(tmp_path / "joint.toml", "virtual", **PENDULUM))
    out = io.StringIO()
    output = Output(json=True, stdout=out, stderr=io.StringIO())
    assert excite(config, output, options=ExciteOptions(lockstep=True, duration_s=40.0)) == 0
    shown = output.stderr.getvalue()
    assert "expected   inertia within" in shown
    assert "condition  " in shown
    assert (tmp_path / "joint.excite.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads(out.getvalue())
    settings = MotionSettings(speed_min_radps=result["speed_min_radps"])
    found = identify_motion(motion_from(Path(result["log"]), ForeignFormat(), settings), settings)
    assert found.parameters["inertia"].value == pytest.approx(2.1, rel=0.12)
    assert math.hypot(found.value["gravity_sin"], found.value["gravity_cos"]) == pytest.approx(20.0, rel=0.05)
    assert found.motion.temperature_degC == pytest.approx(25.0)
    # 10 % above Table 3, and 5 % ripple
    assert 121.0 * found.branches()["positive"].coulomb_Nm == pytest.approx(1.1 * 0.11985 * 121.0, rel=0.1)


def test_a_dry_run_shows_the_motion_and_moves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = load_config(written(tmp_path / "joint.toml", "virtual", **PENDULUM))
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    options = ExciteOptions(lockstep=True)
    assert excite(config, output, options=options, dry_run=True) == 0
    assert "dry run: nothing moved" in output.stderr.getvalue()
    assert not list(tmp_path.glob("runs/*.mcap"))


def test_a_bad_seed_and_a_serial_joint_are_refused() -> None:
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    with pytest.raises(UsageError, match=r"--seed \(=-1\) must be in"):
        excite(load_config(shipped_config("virtual")), output, options=ExciteOptions(seed=-1))
