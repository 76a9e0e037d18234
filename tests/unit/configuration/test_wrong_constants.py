"""Torque constant, ratio, units and sides that are wrong on purpose: refused, or said."""

from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, ForeignFormat, sidecar_contents
from jointctl.tools.identification.identification import Options
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.output import Output
from jointctl.tools.sweeping.checks import constant_remarks, recorded_limits, refuse_constants
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs.identify import identify
from jointctl.tools.verbs.sweep import sweep

QUICK = Options(folds=3, swarm=SwarmSettings(particles=40, iterations=40))
CONFIG = shipped_config("sweep_virtual")
VELOCITY = np.linspace(-200.0, 200.0, 120)  # deg/s of the joint
TORQUE_Nm = friction_curve_Nm(paper_friction(), VELOCITY * DEGREE)  # motor
LIMITS = {"torque_max_Nm": 60.0, "velocity_max_radps": 3.88}


def own_file(folder: Path, torque_Nm: Any = TORQUE_Nm, ratio: float = 121.0, **sidecar: Any) -> Path:
    path = folder / "own.csv"
    lines = [",".join(SWEEP_COLUMNS)]
    for v, t in zip(VELOCITY * DEGREE, torque_Nm, strict=True):
        lines.append(f"{v:.9g},{t / 0.1:.9g},{t:.9g},0.01,0.05,500,1,-0.5,0.5,1.0,,{1 if v > 0 else -1},0")
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".json").write_text(json.dumps(sidecar_contents(ratio, 0.1, **sidecar)))
    return path


def foreign_file(folder: Path) -> Path:
    """Velocity in r/min of the motor, torque of the motor [Nm] and current [A] for 0.1 Nm/A."""
    path = folder / "theirs.csv"
    rows = zip(VELOCITY * 121.0 / 6.0, TORQUE_Nm, TORQUE_Nm / 0.1, strict=True)
    path.write_text("speed,torque,current\n" + "".join(f"{v:.9g},{t:.9g},{i:.9g}\n" for v, t, i in rows))
    return path


RIGHT: dict[str, Any] = {"velocity_column": "speed", "torque_column": "torque", "velocity_unit": "r/min",
                         "side": "motor", "torque_side": "motor", "ratio": 121.0}  # fmt: skip


def identified(path: Path, told: ForeignFormat | None = None, config: Path | None = None) -> str:
    """What was said on stderr."""
    output = Output(stdout=StringIO(), stderr=StringIO())
    assert identify(path, output, config=config, told=told, options=QUICK) == 0
    return output.stderr.getvalue().replace("\n", " ")  # type: ignore[attr-defined, no-any-return]


def test_the_right_constants_raise_no_question(tmp_path: Path) -> None:
    assert "warning" not in identified(foreign_file(tmp_path), ForeignFormat(**RIGHT), CONFIG)
    assert "warning" not in identified(own_file(tmp_path, limits=LIMITS))
    assert "warning" not in identified(own_file(tmp_path, limits=LIMITS), config=CONFIG)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"torque_column": None, "torque_side": None, "current_column": "current", "torque_constant_NmpA": 1.0},
         r"torque constant of the data \(=1 Nm/A\) differs from the configured one \(=0.1 in the drive's ampere"),
        ({"ratio": 100.0},
         r"reduction ratio of the data \(=100\) differs from joint.reduction_ratio \(=121\)"),
        ({"side": "joint"}, r"highest joint speed \(=422.4 rad/s\) is 109 times limits.velocity_max_radps"),
        ({"velocity_unit": "rad/s"}, r"highest joint speed \(=33.33 rad/s\) is 8.59 times limits"),
        ({"velocity_unit": "deg/s"}, r"at positive velocity: .* and 0 beyond; at least"),
    ],
)  # fmt: skip
def test_wrong_flags_are_refused_or_said_with_a_configuration(tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    try:
        text = identified(foreign_file(tmp_path), ForeignFormat(**{**RIGHT, **wrong}), CONFIG)
    except DataError as error:
        text = error.message
    assert re.search(said, text), text


def test_torque_of_the_joint_taken_for_the_motors_and_the_reverse(tmp_path: Path) -> None:
    path = foreign_file(tmp_path)
    told = ForeignFormat(**{**RIGHT, "torque_side": "joint"})
    assert "times limits.torque_max_Nm: check torque constant, ratio, units and sides" in identified(path, told, CONFIG)
    rows = path.read_text().splitlines()
    joint = [rows[0]] + [f"{r.split(',')[0]},{float(r.split(',')[1]) * 121.0:.9g},0" for r in rows[1:]]
    path.write_text("\n".join(joint) + "\n")
    with pytest.raises(DataError, match=r"friction at the joint reaches 4954 Nm, 82.6 times limits.torque_max_Nm"):
        identified(path, ForeignFormat(**RIGHT), CONFIG)


def test_without_any_limits_it_is_said_that_nothing_was_checked(tmp_path: Path) -> None:
    wrong = ForeignFormat(**{**RIGHT, "torque_column": None, "torque_side": None, "current_column": "current",
                             "torque_constant_NmpA": 10.0})  # fmt: skip
    text = identified(foreign_file(tmp_path), wrong)
    assert "no limits of the joint are known: sizes of torque and speed could not be checked" in text
    assert "no limits of the joint are known" in identified(own_file(tmp_path))


@pytest.mark.parametrize(("factor", "refused"), [(1.7, False), (1.9, True), (10.0, True)])
def test_the_sidecars_limits_serve_where_no_configuration_is_given(
    tmp_path: Path, factor: float, refused: bool
) -> None:
    # 95 % of the points are below 41 Nm at the joint; 1.2 times the 60 Nm of the sidecar are allowed
    path = own_file(tmp_path, factor * TORQUE_Nm, limits=LIMITS)
    if refused:
        with pytest.raises(DataError, match=r"friction at the joint reaches .* times limits.torque_max_Nm"):
            identified(path)
    else:
        assert "times limits.torque_max_Nm" in identified(path)  # near the limit


def test_a_ratio_that_contradicts_the_sidecar_is_refused(tmp_path: Path) -> None:
    path = own_file(tmp_path, limits=LIMITS)
    with pytest.raises(DataError, match=r"--ratio \(=100\) differs from reduction_ratio \(=121\)"):
        identified(path, ForeignFormat(ratio=100.0))
    assert "warning" not in identified(path, ForeignFormat(ratio=121.0))


@pytest.mark.parametrize("limits", [3, {"torque_max_Nm": -1.0, "velocity_max_radps": 1.0}, {"torque_max_Nm": 60.0}])
def test_damaged_limits_of_a_sidecar_are_named(tmp_path: Path, limits: Any) -> None:
    with pytest.raises(DataError, match=r"own.json: limits\.\w+ \(=.*\) must be a number"):
        identified(own_file(tmp_path, limits=limits))


def with_constant(torque_constant_NmpA: float) -> Config:
    config = load_config(CONFIG)
    joint = config.joint.model_copy(update={"torque_constant_NmpA": torque_constant_NmpA})
    return config.model_copy(update={"joint": joint})


@pytest.mark.parametrize("constant", [0.1, 0.0801, 0.1249])
def test_constants_that_agree_need_no_remark(constant: float) -> None:
    refuse_constants(with_constant(constant))
    assert constant_remarks(with_constant(constant)) == []


@pytest.mark.parametrize(
    ("constant", "factor"), [(0.0799, "0.799"), (0.1251, "1.25"), (0.141, "1.41"), (0.299, "2.99")]
)
def test_doubtful_constants_are_shown_before_the_joint_moves(constant: float, factor: str) -> None:
    config = with_constant(constant)
    refuse_constants(config)
    (remark,) = constant_remarks(config)
    assert f"is {factor} times drive.rated_torque_Nm (=0.5)" in remark
    assert "rms and sine amplitude" in remark


@pytest.mark.parametrize("constant", [0.033, 0.301, 1.0])
def test_impossible_constants_are_refused_before_anything_moves(tmp_path: Path, constant: float) -> None:
    output = Output(stdout=StringIO(), stderr=StringIO())
    with pytest.raises(ConfigurationError, match=r"joint.torque_constant_NmpA \(=.* times drive.rated_torque_Nm"):
        sweep(with_constant(constant), output, tmp_path / "data.csv", SweepOptions(lockstep=True, points=4))
    assert list(tmp_path.iterdir()) == []


def test_the_serial_drive_has_no_rated_torque_to_compare_with() -> None:
    config = load_config(shipped_config("elmo_serial"))
    refuse_constants(config)
    assert constant_remarks(config) == []
    assert recorded_limits(config) == {"torque_max_Nm": 60.0, "velocity_max_radps": 1.0}
