"""Torques next to zero, and numbers beyond all measure, in a table of friction: a result or one line."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.identification.friction_data import (
    LEAST_SHARE,
    read_friction_data,
    relative_errors,
    relative_figures,
)
from jointctl.tools.output import Output
from jointctl.tools.verbs.validate import validate
from tests.places import CONFIGS

SPEEDS = [0.1 * k for k in range(-10, 11) if k]


def table(folder: Path, *, first: str, others: float = 0.2) -> Path:
    path = folder / "sweep.csv"
    torques = [first, *(repr(math.copysign(others, speed)) for speed in SPEEDS[1:])]
    lines = [f"{speed!r},{torque}" for speed, torque in zip(SPEEDS, torques, strict=True)]
    path.write_text("\n".join(["velocity_radps,motor_torque_Nm", *lines, ""]))
    path.with_suffix(".json").write_text('{"reduction_ratio": 121, "torque_constant_NmpA": 0.1}')
    return path


@pytest.mark.parametrize("first", ["-1e-320", "-5e-324", "0.0", "-1e-308", "-1e-13", "-0.2"])
def test_a_torque_next_to_zero_is_validated(tmp_path: Path, first: str) -> None:
    out = io.StringIO()
    path = table(tmp_path, first=first)
    assert validate(CONFIGS / "virtual.toml", path, Output(json=True, stdout=out, stderr=io.StringIO())) == 0
    assert 0.0 < json.loads(out.getvalue())["relative_rmse"] < 10.0
    assert path.with_suffix(".validation.png").stat().st_size > 10_000


def test_nothing_but_such_torques(tmp_path: Path) -> None:
    out = io.StringIO()
    path = table(tmp_path, first="-1e-320", others=1e-320)
    assert validate(CONFIGS / "virtual.toml", path, Output(json=True, stdout=out, stderr=io.StringIO())) == 0
    assert json.loads(out.getvalue())["relative_rmse"] is None


@pytest.mark.parametrize("text", ["1_0", "nan", "inf", "1e101", "-1e308", "٣", ""])
def test_what_is_no_number_of_a_table(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match=r"line 2: motor_torque_Nm \(=.*\) must be a finite number"):
        read_friction_data(table(tmp_path, first=text))


def test_the_share_from_which_on_an_error_is_one() -> None:
    measured = np.array([1.0, 1.001 * LEAST_SHARE, 0.999 * LEAST_SHARE, -1.0])
    found = relative_errors(np.full(4, 0.5), measured)
    assert np.isfinite(found).tolist() == [True, True, False, True]
    assert relative_figures(np.full(2, 0.5), np.array([1.0, -2.0])) == pytest.approx((math.sqrt(0.15625), 0.5, 0.125))
