"""Sweeps of the virtual joint in lockstep: the curve that comes out, and what is kept after a fault."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import DECLINED, DataError, DeviceError, MotionFault
from jointctl.tools.configuration.canopen import eds_path
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.sweeping.options import SweepOptions, SweepPoint
from jointctl.tools.verbs.sweep import Sweep, sweep
from tests.hil.sweep_rows import rows, truth_Nm
from tests.sessions import output

QUANTISATION_Nm = 0.0005  # one per mille of the rated motor torque


@pytest.fixture
def config() -> Config:
    return load_config(shipped_config("sweep_virtual"))


def swept(config: Config, out: Path, **options: Any) -> Any:
    """The rows of a sweep in lockstep."""
    assert sweep(config, output()[0], out, SweepOptions(lockstep=True, **options)) == 0
    return rows(out)


@pytest.mark.parametrize(("mode", "tolerance_Nm"), [("csv", 0.001), ("pv", 0.001), ("torque", 0.003)])
def test_the_swept_curve_is_the_sliding_curve_of_the_joint(
    config: Config, tmp_path: Path, mode: str, tolerance_Nm: float
) -> None:
    found = swept(config, tmp_path / "data.csv", points=24, mode=mode)
    assert len(found) == 24
    assert np.all(found["settled"] == 1)
    assert np.sum(found["velocity_radps"] > 0.0) == 12
    assert np.all(found["position_min_rad"] > config.limits.position_min_rad)
    assert np.all(found["position_max_rad"] < config.limits.position_max_rad)
    assert np.max(np.abs(found["velocity_radps"])) < config.limits.velocity_max_radps
    error_Nm = found["motor_torque_Nm"] - truth_Nm(config, found["velocity_radps"])
    assert np.max(np.abs(error_Nm)) < tolerance_Nm + QUANTISATION_Nm
    sidecar = json.loads((tmp_path / "data.json").read_text())
    assert sidecar["reduction_ratio"] == 121.0
    assert sidecar["drive"]["mode"] == {"csv": "cyclic_sync_velocity", "pv": "profile_velocity"}.get(
        mode, "cyclic_sync_torque"
    )
    # the drive's own limit, written and read back: 3.88 rad/s in counts/s
    limit = sidecar["drive"].get("max velocity")
    assert limit == (None if mode == "torque" else "323759 counts/s = 3.88 rad/s")


def test_points_that_do_not_settle_are_visited_again_and_marked(config: Config, tmp_path: Path) -> None:
    # too little damping for the negative slope of Stribeck friction: the joint sticks and slips
    weak = {"control__kp": 400.0, "control__kv": 12.0, "control__observer_radps": 3.0}
    joint = config.changed(virtual__friction_kind="stick_slip", **weak)
    options = {"points": 4, "min_speed_radps": 0.008, "max_speed_radps": 0.016, "mode": "torque"}
    shown, _, err = output()
    assert sweep(joint, shown, tmp_path / "data.csv", SweepOptions(lockstep=True, **options)) == 0
    found = rows(tmp_path / "data.csv")
    unsettled = found[found["settled"] == 0]
    assert len(unsettled) > 0
    assert len(found) > 4
    sidecar = json.loads((tmp_path / "data.json").read_text())
    assert all(sidecar["unsettled"].values())
    assert f"; the last one: {[*sidecar['unsettled'].values()][-1]}; a longer --dwell" in err.getvalue()


def eds_with_modes(config: Config, folder: Path, supported: int) -> Config:
    """The configuration of a drive with other supported modes (6502)."""
    text = eds_path(config).read_text()
    assert text.count("DefaultValue=0x000003AD") == 1
    (folder / "drive.eds").write_text(text.replace("DefaultValue=0x000003AD", f"DefaultValue=0x{supported:08X}"))
    (folder / "joint.toml").write_text(config.text.replace('eds = "virtual_joint.eds"', 'eds = "drive.eds"'))
    return load_config(folder / "joint.toml")


def test_a_fault_before_the_first_point_leaves_no_file_and_says_so(config: Config, tmp_path: Path) -> None:
    weak = config.changed(limits__torque_max_Nm=33.0)
    with pytest.raises(MotionFault, match="nothing was measured") as error:
        swept(weak, tmp_path / "data.csv", points=12)
    assert "--resume" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("supported", "mode"),
    [(0x38D, "cyclic_sync_velocity"), (0x28D, "profile_velocity"), (0x281, "cyclic_sync_torque"), (0x8, "torque")],
)
def test_auto_takes_the_best_mode_that_the_drive_has(config: Config, tmp_path: Path, supported: int, mode: str) -> None:
    joint = eds_with_modes(config, tmp_path, supported)
    swept(joint, tmp_path / "data.csv", points=2, max_speed_radps=1.0, min_speed_radps=0.9, grid="log")
    assert json.loads((tmp_path / "data.json").read_text())["drive"]["mode"] == mode


@pytest.mark.parametrize(("supported", "mode"), [(0x281, "csv"), (0x381, "pv"), (0x181, "torque")])
def test_a_mode_that_the_drive_lacks_is_a_device_error(
    config: Config, tmp_path: Path, supported: int, mode: str
) -> None:
    joint = eds_with_modes(config, tmp_path, supported)
    with pytest.raises(DeviceError, match="does not support") as error:
        swept(joint, tmp_path / "data.csv", points=2, mode=mode)
    assert error.value.exit_code == 6
    assert not (tmp_path / "data.csv").exists()


def test_a_fault_keeps_what_was_measured_and_resume_completes_it(config: Config, tmp_path: Path) -> None:
    # the first speeds need less torque than the limit, the fastest more: the drive saturates
    # (the warm-up at half the fastest speed needs 35 Nm, without a ripple that would lift it off the limit)
    weak = config.changed(limits__torque_max_Nm=36.0)
    out = tmp_path / "data.csv"
    with pytest.raises(MotionFault, match=r"points are in"):
        swept(weak, out, points=12)
    kept = out.read_text()
    done = len(rows(out))
    assert 2 < done < 12
    found = swept(config, out, points=12, resume=True)
    assert len(found) == 12
    assert out.read_text().startswith(kept)
    assert np.all(np.diff(found["time_s"]) > 0.0)
    error_Nm = found["motor_torque_Nm"] - truth_Nm(config, found["velocity_radps"])
    assert np.max(np.abs(error_Nm)) < 0.002
    told, _, err = output()
    page = tmp_path / "sweep.html"
    assert sweep(config, told, out, SweepOptions(lockstep=True, points=12, resume=True, report=page)) == 0
    assert "<svg" in page.read_text()
    assert "12 of 12" in page.read_text()
    assert "nothing is left" in err.getvalue()


def test_the_same_sweep_twice_gives_the_same_rows(config: Config, tmp_path: Path) -> None:
    first = swept(config, tmp_path / "a.csv", points=4, shuffle_seed=3)
    second = swept(config, tmp_path / "b.csv", points=4, shuffle_seed=3)
    assert np.array_equal(first["motor_torque_Nm"], second["motor_torque_Nm"])


def test_a_dry_run_in_lockstep_writes_nothing(config: Config, tmp_path: Path) -> None:
    told, _, err = output()
    options = SweepOptions(lockstep=True, points=4, dry_run=True)
    assert sweep(config, told, tmp_path / "data.csv", options) == 0
    text = err.getvalue()
    for word in ("approach", "sweep      4 points", "motion", "limits", "dry run"):
        assert word in text
    assert list(tmp_path.iterdir()) == []


def test_resume_revisits_what_did_not_settle_and_only_once(config: Config, tmp_path: Path) -> None:
    out = tmp_path / "data.csv"
    swept(config, out, points=4)
    sidecar = json.loads(out.with_suffix(".json").read_text())
    sidecar["unsettled"] = {"2": "stopped before its second visit"}
    out.with_suffix(".json").write_text(json.dumps(sidecar))
    told, _, err = output()
    assert sweep(config, told, out, SweepOptions(lockstep=True, points=4, resume=True)) == 0
    assert "1 point did not settle: once more" in err.getvalue()
    sidecar = json.loads(out.with_suffix(".json").read_text())
    assert sidecar["measured"] == [0, 1, 2, 3, 2]
    assert sidecar["unsettled"] == {}
    sidecar["unsettled"] = {"2": "not even the second time"}
    out.with_suffix(".json").write_text(json.dumps(sidecar))
    told, _, err = output()
    assert sweep(config, told, out, SweepOptions(lockstep=True, points=4, resume=True)) == 0
    assert "nothing is left" in err.getvalue()
    assert len(rows(out)) == 5


def test_a_sweep_under_loads_has_them_in_its_rows_and_goes_on_where_it_was(config: Config, tmp_path: Path) -> None:
    out = tmp_path / "data.csv"
    options: dict[str, Any] = {"points": 4, "loads_Nm": [0.0, 8.0], "mode": "torque"}
    found = swept(config, out, **options)
    assert found["load_Nm"].tolist() == [0.0] * 4 + [8.0] * 4
    assert found["pass"].tolist() == [0] * 4 + [1] * 4
    error_Nm = found["motor_torque_Nm"] - truth_Nm(config, found["velocity_radps"])  # the load is taken off
    assert np.max(np.abs(error_Nm)) < 0.004
    text, sidecar = out.read_text(), json.loads(out.with_suffix(".json").read_text())
    sidecar["measured"] = sidecar["measured"][:5]
    out.with_suffix(".json").write_text(json.dumps(sidecar))
    again = swept(config, out, **options, resume=True)
    assert out.read_text().splitlines()[:6] == text.splitlines()[:6]
    assert again["load_Nm"].tolist() == found["load_Nm"].tolist()
    with pytest.raises(DataError, match="was measured with another plan"):
        swept(config, out, points=4, loads_Nm=[0.0, 7.0], mode="torque", resume=True)


def test_each_load_is_asked_for_and_without_it_nothing_moves(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, measured = list[str](), list[float]()

    def answer(_: Any, question: str) -> bool:
        asked.append(question)
        return len(asked) == 1

    def measure(points: list[SweepPoint], *_: float) -> str:
        measured.append(points[0].condition.load_Nm)
        return ""

    monkeypatch.setattr("jointctl.tools.session.plan.agreed", answer)
    command = Sweep(config, output()[0], tmp_path / "data.csv", SweepOptions(points=4, loads_Nm=[0.0, 8.0]))
    monkeypatch.setattr(command, "_measure", measure)
    assert command.run() == DECLINED
    assert measured == [0.0]
    assert asked[1] == "A load of 8 Nm at the joint: is it attached?"
