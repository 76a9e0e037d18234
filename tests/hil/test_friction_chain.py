"""Sweep, identify, run: a virtual joint whose friction the software does not know, from measuring to tracking."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import friction_constants
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.sections import Friction
from jointctl.tools.identification.friction_data import read_friction_data
from jointctl.tools.identification.identification import Options, identify_friction
from jointctl.tools.identification.identification_report import section_values
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs.sweep import sweep
from tests.sessions import output

POINTS = 60
SMALL = {"folds": 3, "swarm": SwarmSettings(particles=60, iterations=100)}


@pytest.fixture(scope="module")
def bench() -> Config:
    return load_config(shipped_config("sweep_virtual"))


def true_friction(config: Config) -> Friction:
    assert config.virtual.friction is not None
    return config.virtual.friction


def with_knee(friction: Friction, knee_degps: float, break_Nm: float = 0.0) -> Friction:
    """The same first stages up to another knee; the cubics are shifted so that the curve steps by `break_Nm`."""

    def moved(d: Any, sign: float) -> Any:
        speed = knee_degps
        low = d.tc_Nm + (d.ts_Nm - d.tc_Nm) * np.exp(-speed / d.ws) + d.tv * speed
        u = sign * speed
        rest = sign * (d.a1 * u + d.a2 * u**2 + d.a3 * u**3)
        return d.model_copy(update={"knee": u, "a0": sign * (low + break_Nm - rest)})

    return friction.model_copy(
        update={"positive": moved(friction.positive, 1.0), "negative": moved(friction.negative, -1.0)}
    )


def data_of(config: Config, folder: Path, **options: Any) -> Any:
    out = folder / "data.csv"
    assert sweep(config, output()[0], out, SweepOptions(lockstep=True, **{"points": POINTS, **options})) == 0
    return read_friction_data(out)


def model_of(data: Any, **options: Any) -> Friction:
    found = identify_friction(data, Options(**{**SMALL, **options})).branches
    return Friction.model_validate(section_values(found["positive"], found["negative"]))


def worst_error(found: Friction, true: Friction) -> float:
    """Greatest error over +-200 deg/s, as a share of the greatest friction; zero itself is set-valued."""
    speeds = np.concatenate([np.geomspace(0.2, 5.0, 200), np.linspace(5.0, 200.0, 600)]) * DEGREE
    both = np.concatenate([-speeds, speeds])
    true_Nm = friction_curve_Nm(friction_constants(true, 121.0), both)
    error_Nm = friction_curve_Nm(friction_constants(found, 121.0), both) - true_Nm
    return float(np.max(np.abs(error_Nm)) / np.max(np.abs(true_Nm)))


@pytest.fixture(scope="module")
def identified(bench: Config, tmp_path_factory: pytest.TempPathFactory) -> Friction:
    return model_of(data_of(bench, tmp_path_factory.mktemp("sweep")))


def test_the_identified_curve_is_within_two_percent(bench: Config, identified: Friction) -> None:
    assert worst_error(identified, true_friction(bench)) < 0.02


def test_a_noisy_joint_is_identified_as_well(bench: Config, tmp_path: Path) -> None:
    rough = bench.changed(virtual__torque_ripple_Nm=(1.5, 0.5), virtual__friction_ripple=0.08)
    # one count a period of this encoder is 0.05 rad/s: less than that cannot be told from standing
    data = data_of(rough.changed(encoder__counts_per_turn=2**17, limits__standstill_radps=0.1), tmp_path)
    assert len(data.direction(1)) + len(data.direction(-1)) >= 0.9 * POINTS
    assert worst_error(model_of(data), true_friction(bench)) < 0.02


KNEE_DEGPS = 70.0


@pytest.fixture(scope="module")
def late(bench: Config, tmp_path_factory: pytest.TempPathFactory) -> tuple[Friction, Any]:
    """A joint whose stages meet at 70 deg/s with a step, and its sweep."""
    friction = with_knee(true_friction(bench), KNEE_DEGPS, 0.02)
    return friction, data_of(bench.changed(virtual__friction=friction), tmp_path_factory.mktemp("late"))


def test_another_knee_is_found_by_searching(late: tuple[Friction, Any]) -> None:
    friction, data = late
    found = model_of(data, search_knee=True)
    between = np.diff(np.sort(np.abs(data.velocity_radps[data.direction(1)])) / DEGREE).max()
    assert found.positive.knee == pytest.approx(KNEE_DEGPS, abs=between)
    assert found.negative.knee == pytest.approx(-KNEE_DEGPS, abs=between)
    # the knee itself lies somewhere between two plateaus: beside them the curve is right
    speeds = np.concatenate(
        [np.linspace(1.0, KNEE_DEGPS - between, 200), np.linspace(KNEE_DEGPS + between, 200.0, 200)]
    )
    both = np.concatenate([-speeds, speeds]) * DEGREE
    true_Nm = friction_curve_Nm(friction_constants(friction, 121.0), both)
    error_Nm = friction_curve_Nm(friction_constants(found, 121.0), both) - true_Nm
    assert np.max(np.abs(error_Nm)) < 0.02 * np.max(np.abs(true_Nm))


def test_the_knee_of_the_paper_describes_such_a_joint_worse(late: tuple[Friction, Any]) -> None:
    _, data = late
    given = identify_friction(data, Options(**SMALL))
    searched = identify_friction(data, Options(search_knee=True, **SMALL))
    assert given.rmse_Nm > 10.0 * searched.rmse_Nm
    assert given.rmse_Nm < 0.02 * np.max(np.abs(data.motor_torque_Nm))  # poorer, not absurd


def test_a_smooth_knee_elsewhere_is_within_two_percent_when_searched(bench: Config, tmp_path: Path) -> None:
    friction = with_knee(true_friction(bench), 25.0)
    data = data_of(bench.changed(virtual__friction=friction), tmp_path)
    assert worst_error(model_of(data, search_knee=True), friction) < 0.02


def tracking_rmse_rad(config: Config, true: Friction, believed: Friction) -> float:
    """Of the paper's sine on R1, after the first period."""
    lugre = config.friction.lugre if config.friction is not None else None
    joint = config.changed(
        friction=believed, friction__lugre=lugre, trajectory__duration_s=30.0,
        virtual__friction=true, virtual__friction_positive_scale=1.0, virtual__friction_negative_scale=1.0,
    )  # fmt: skip
    run = LockstepJoint(joint).run()
    assert run.fault == 0
    errors = run.true_error_rad[run.tracking]
    return float(np.sqrt(np.mean(errors[len(errors) // 3 :] ** 2)))


def test_tracking_with_the_identified_model_is_that_with_the_true_one(bench: Config, identified: Friction) -> None:
    config = load_config(shipped_config("virtual"))
    true = true_friction(bench)
    with_truth = tracking_rmse_rad(config, true, true)
    with_found = tracking_rmse_rad(config, true, identified)
    assert with_found == pytest.approx(with_truth, rel=0.1)
    # and the model matters at all
    assert config.friction is not None  # Table 3: a tenth to a sixth less
    assert tracking_rmse_rad(config, true, config.friction) > 1.3 * with_truth
