"""The commands as functions, and what `import jointctl` gives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jointctl
from tests.places import CONFIGS


def test_every_name_is_there_and_typed() -> None:
    for name in jointctl.__all__:
        assert getattr(jointctl, name) is not None
    assert Path(jointctl.__file__).with_name("py.typed").exists()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = jointctl.nothing  # type: ignore[attr-defined]


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, jointctl; print([m for m in ('numpy', 'numba', 'scipy', 'can', 'matplotlib') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_check_gives_the_margins() -> None:
    report = jointctl.check("virtual")
    assert report["verdict"] == "ok"
    assert report["margins"]["phase_margin_deg"] > 20.0
    with pytest.raises(jointctl.MarginError, match="phase margin"):
        jointctl.check(CONFIGS / "virtual.toml", delay_s=0.02)
    with pytest.raises(TypeError, match="check\\(\\) has no option 'dellay'"):
        jointctl.check("virtual", dellay=1.0)
    with pytest.raises(jointctl.ConfigurationError):
        jointctl.check("no_such_file.toml")


def test_identify_gives_the_model_and_writes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "sweep.csv"
    speeds_degps = np.concatenate([s * np.geomspace(0.5, 60.0, 40) for s in (1.0, -1.0)])
    shape = 10.0 + 4.0 * np.exp(-((speeds_degps / 5.0) ** 2)) + 0.1 * np.abs(speeds_degps)
    rows = "\n".join(f"{v:.6f},{t:.8f}" for v, t in zip(speeds_degps, np.sign(speeds_degps) * shape, strict=True))
    path.write_text(f"speed,torque\n{rows}\n")
    table = {
        "velocity_column": "speed", "torque_column": "torque", "velocity_unit": "deg/s", "side": "joint",
        "torque_side": "joint", "ratio": 100.0,
    }  # fmt: skip
    found = jointctl.identify(path, table=table, model="stribeck")
    assert found.model == "stribeck"
    assert found.rmse_Nm < 5e-3
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.csv"]
    with pytest.raises(jointctl.DataError, match="speed"):
        jointctl.identify(path)


def test_a_log_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no log")
    with pytest.raises(jointctl.DataError, match="is not an MCAP file"):
        jointctl.read_log(tmp_path / "x.mcap")
