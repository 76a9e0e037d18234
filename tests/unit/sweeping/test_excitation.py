"""The motion of `excite`: within the limits, the best of its candidates, and honest about what it will tell."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jointctl.drivers.errors import UsageError
from jointctl.firmware_py.motion_records import TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.firmware_py.trajectory import peak_of
from jointctl.tools.configuration.config import Config
from jointctl.tools.drawing import png
from jointctl.tools.sweeping import excitation
from jointctl.tools.sweeping.excitation import TORQUE_SHARE, Design, believed, designed, excitation_figure
from tests.configurations import shipped


@pytest.fixture(scope="module")
def config() -> Config:
    """A pendulum with room to move."""
    return shipped("virtual", joint__gravity_Nm=20.0, limits__position_min_rad=-1.5, limits__position_max_rad=1.2)


@pytest.fixture(scope="module")
def design(config: Config) -> Design:
    return designed(config, 60.0, 1)


def peak(table: np.ndarray) -> tuple[float, ...]:
    constants = new(TrajectoryConstants)
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(table)
    constants[0].duration_s = table[-1, 0]
    return tuple(float(x) for x in peak_of(constants[0], table))


def test_the_motion_stays_within_the_limits_and_begins_and_ends_at_rest(config: Config, design: Design) -> None:
    low, high, speed, acceleration = peak(design.motion.table)
    limits, margin = config.limits, config.limits.following_error_max_rad
    assert design.middle_rad == pytest.approx(-0.15)
    assert design.middle_rad + low >= limits.position_min_rad + margin - 1e-3
    assert design.middle_rad + high <= limits.position_max_rad - margin + 1e-3
    assert speed <= 0.9 * limits.velocity_max_radps * 1.001
    assert acceleration <= 0.8 * config.sequence.brake_radps2 * 1.02
    assert np.max(np.abs(design.torque_Nm)) <= TORQUE_SHARE * limits.torque_max_Nm
    assert design.motion.duration_s == pytest.approx(60.0, abs=8.0)
    first, last = design.motion.table[0], design.motion.table[-1]
    assert (first[0], first[1], first[2]) == (0.0, 0.0, 0.0)
    assert (last[1], last[2]) == (pytest.approx(0.0, abs=1e-9), 0.0)
    rows = design.motion.table
    d = np.diff(rows[:, 0])
    ends = rows[:-1, 1] + d * (rows[:-1, 2] + d * (rows[:-1, 3] + d * rows[:-1, 4]))
    assert np.max(np.abs(ends - rows[1:, 1])) < 1e-6
    assert np.all(d > 0.0)


def test_the_best_of_the_candidates_is_taken_and_its_seed_repeats_it(
    config: Config, design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert np.array_equal(designed(config, 60.0, 1).motion.table, design.motion.table)
    monkeypatch.setattr(excitation, "CANDIDATES", 5)
    assert designed(config, 60.0, 1).condition >= design.condition
    assert not np.array_equal(designed(config, 60.0, 2).motion.table[:, 1], design.motion.table[:, 1])


def test_a_longer_motion_tells_more_and_a_joint_without_load_cannot_tell_load_friction(
    config: Config, design: Design
) -> None:
    assert set(design.known) == {name.replace("log_ws", "ws") for name in believed(config)[0].names}
    longer = designed(config, 240.0, 1)
    assert longer.known["tc positive"] < design.known["tc positive"]
    still = designed(config.changed(joint__gravity_Nm=0.0), 60.0, 1)
    assert still.known["load_coulomb"] > 2.0 * design.known["load_coulomb"]
    lines = [line for line in still.untold if line.startswith("load_coulomb: not expected")]
    assert lines
    assert lines[0].endswith("move both ways under two loads or more")
    assert any(line.startswith("temperature: once more") for line in still.untold)


def test_a_joint_without_a_friction_model_gets_a_motion_too(config: Config) -> None:
    bare = config.changed(friction=None)
    assert designed(bare, 60.0, 1).known["inertia"] < 0.5


@pytest.mark.parametrize(
    ("changes", "duration_s", "text"),
    [
        ({}, 5.0, r"--duration \(=5\) must be in \[20..1800\]"),
        ({}, math.nan, r"--duration \(=nan\)"),
        ({"limits__torque_max_Nm": 15.0}, 60.0, r"limits.torque_max_Nm \(=15\) must leave room for gravity"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    config: Config, changes: dict[str, float], duration_s: float, text: str
) -> None:
    with pytest.raises(UsageError, match=text):
        designed(config.changed(**changes), duration_s, 1)


def test_the_picture_shows_the_motion(design: Design) -> None:
    assert png(excitation_figure(design, "joint")).startswith(b"\x89PNG")
