"""The stiffness of bristles from torque and counts of a joint that stands, and the motion that makes them."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.tuning import presliding
from jointctl.tools.tuning.carry_out import Carried, Carrier
from jointctl.tools.tuning.presliding import (
    AMPLITUDE,
    FROZEN_STRETCHES,
    REACH,
    SIDES,
    Bristles,
    RAMP_s,
    bend_Nm,
    bristle_values,
    bristles_text,
    fit_bristles,
    measured_bristles,
    noise_of,
    presliding_motion,
    stretches_of,
)
from tests.configurations import shipped

PERIOD_s = 0.001
TURN_rad = math.tau


def triangle_Nm(begin_Nm: float, size_Nm: float) -> np.ndarray:
    """Of one place: from there to either side, in turn."""
    ends = [begin_Nm, *(side * size_Nm for side in SIDES)]
    return np.concatenate([np.linspace(a, b, round(RAMP_s / PERIOD_s)) for a, b in pairwise(ends)])


def way_rad(torque_Nm: np.ndarray, stiffness_Nmprad: float, friction_Nm: tuple[float, float]) -> np.ndarray:
    """LuGre, z' = v (1 - sigma0 |z| sign(z v) / F), at no speed to speak of: sigma0 z = T; a step is one of five."""
    cycles = np.arange(len(torque_Nm))
    z = np.interp(np.linspace(0.0, cycles[-1], 5 * cycles[-1] + 1), cycles, torque_Nm) / stiffness_Nmprad
    dz = np.diff(z)
    slides_at = np.where(dz > 0.0, friction_Nm[0], -friction_Nm[1])
    steps = dz / (1.0 - stiffness_Nmprad * z[:-1] / slides_at)
    return np.concatenate(([0.0], np.cumsum(steps)))[::5]


def measured(
    stiffness_Nmprad: float, friction_Nm: tuple[float, float], resolution_rad: float, noise: float, seed: int,
    places: int = 30, slip_rad: float = 0.0,
) -> Bristles | None:  # fmt: skip
    """The fit of that many places with an encoder like that; infinitely stiff: nothing moves; a slip in every third."""
    random, found, variances = np.random.default_rng(seed), [], []
    static_Nm = 0.5 * sum(friction_Nm)
    for place in range(places):
        torque = triangle_Nm(random.uniform(0.4, 0.7) * min(friction_Nm), AMPLITUDE * min(friction_Nm))
        way = np.zeros_like(torque)
        if math.isfinite(stiffness_Nmprad):
            way = way_rad(torque, stiffness_Nmprad, friction_Nm)
        if place % 3 == 0:
            way[len(way) // 2 :] += slip_rad
        read = way / resolution_rad + random.uniform(-50.0, 50.0) + noise * random.standard_normal(len(torque))
        stretches, variance = stretches_of(torque, np.round(read), friction_Nm, PERIOD_s)
        found += stretches
        variances.append(variance)
    return fit_bristles(found, static_Nm, resolution_rad, noise_of(float(np.mean(np.concatenate(variances)))))


@settings(max_examples=15, deadline=None, derandomize=True, phases=[Phase.generate])
@given(
    bend_counts=st.floats(0.1, 30.0), static_Nm=st.floats(0.5, 40.0), side=st.floats(0.75, 1.0),
    bits=st.integers(14, 20), noise=st.floats(0.0, 0.6), seed=st.integers(0, 1000),
)  # fmt: skip
def test_any_bristles_are_found(
    bend_counts: float, static_Nm: float, side: float, bits: int, noise: float, seed: int
) -> None:
    """From a tenth of a count at the static friction on; a fit that is far off has an interval that says so."""
    resolution_rad, friction_Nm = TURN_rad / 2**bits, (static_Nm, side * static_Nm)
    true = static_Nm / (bend_counts * resolution_rad)
    found = measured(true, friction_Nm, resolution_rad, noise, seed)
    assert found is not None
    assert found.least_Nmprad < 1.1 * true
    assert found.most_Nmprad > true / 1.1
    assert found.least_Nmprad <= found.stiffness_Nmprad <= found.most_Nmprad
    if bend_counts > 0.5:
        assert found.stiffness_Nmprad == pytest.approx(true, rel=0.3)
        assert found.most_Nmprad < 2.5 * found.least_Nmprad


@settings(max_examples=6, deadline=None, derandomize=True, phases=[Phase.generate])
@given(bits=st.integers(12, 20), noise=st.floats(0.0, 0.6), seed=st.integers(0, 1000))
def test_of_a_rigid_contact_a_bound_is_known(bits: int, noise: float, seed: int) -> None:
    """It bends by less than a fifth of a count."""
    resolution_rad = TURN_rad / 2**bits
    found = measured(math.inf, (19.0, 17.0), resolution_rad, noise, seed)
    assert found is not None
    assert (found.stiffness_Nmprad, found.most_Nmprad) == (math.inf, math.inf)
    assert found.least_Nmprad > 18.0 / (0.2 * resolution_rad)


@pytest.mark.parametrize("stiffness_Nmprad", [math.inf, 8e4])
@pytest.mark.parametrize("bits", [14, 17, 20])
def test_a_joint_that_slips_has_no_bristles_as_soft_as_that(bits: int, stiffness_Nmprad: float) -> None:
    """A light joint that sticks and slips is dragged on by the spring; 8e4 Nm/rad bend by 0.2 mrad."""
    friction_Nm, resolution_rad = (17.0, 16.0), TURN_rad / 2**bits
    assert measured(stiffness_Nmprad, friction_Nm, resolution_rad, 0.3, 1, slip_rad=4e-3) is None
    assert measured(stiffness_Nmprad, friction_Nm, resolution_rad, 0.3, 1) is not None


def test_a_fine_encoder_takes_no_more_memory_than_a_coarse_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 24 bit on a motor with 1 : 100 bristles bend by 6e4 counts; as noise of the readings they took 10 GB."""
    ndtr, sizes = presliding.ndtr, list[int]()

    def counted(values: np.ndarray) -> np.ndarray:
        sizes.append(values.size)
        assert values.size < 100_000
        return np.asarray(ndtr(values))

    monkeypatch.setattr(presliding, "ndtr", counted)
    found = measured(8e4, (19.0, 17.0), TURN_rad / (100 * 2**24), 0.3, 1)
    assert sizes
    assert found is not None
    assert found.stiffness_Nmprad == pytest.approx(8e4, rel=0.1)


def test_too_few_places_say_nothing() -> None:
    assert measured(8e4, (19.0, 19.0), 1e-5, 0.0, 1, places=9) is None
    assert measured(8e4, (19.0, 19.0), 1e-5, 0.0, 1, places=10) is not None


def test_a_time_in_which_the_joint_may_have_slid_is_left_out() -> None:
    """At 0.8 of the static friction it creeps by more than the bristles bend."""
    torque = triangle_Nm(0.0, 0.5 * 19.0)
    whole, _ = stretches_of(torque, torque, (19.0, 19.0), PERIOD_s)
    assert len(whole) == 1
    torque[850:950] = 0.8 * 19.0
    parts, _ = stretches_of(torque, torque, (19.0, 19.0), PERIOD_s)
    assert [len(part.counts) for part in parts] == [34, len(whole[0].counts) - len(parts[0].counts) - 4]


@pytest.mark.parametrize("noise", [0.0, 0.3, 0.7])
def test_noise_is_found_from_the_spread_of_the_counts(noise: float) -> None:
    random = np.random.default_rng(3)
    read = np.round(random.uniform(-5.0, 5.0, (4000, 1)) + noise * random.standard_normal((4000, 25)))
    assert noise_of(float(np.mean(read.var(axis=1, ddof=1)))) == pytest.approx(noise, abs=0.05)


def test_the_position_is_a_hysteresis_of_the_torque() -> None:
    """A way there and back of the same torques ends where it began; away from zero it is softer."""
    up = np.linspace(-10.0, 10.0, 2001)
    bend = bend_Nm(np.concatenate((up, up[::-1])), 20.0, 20.0)
    assert bend[-1] == pytest.approx(0.0, abs=1e-9)
    assert bend[2000] == pytest.approx(20.0 * math.log(1.5 / 0.5), rel=1e-4)
    assert bend[2000] - bend[1900] > 1.3 * (bend[1100] - bend[1000])


def test_the_joint_is_pushed_less_than_breaks_it_away_and_its_reading_is_watched() -> None:
    config = shipped("precise")
    motion = presliding_motion(config)
    assert motion is not None
    spring_Nmprad = motion.config.control.kp * config.joint.inertia_kgm2
    assert spring_Nmprad * motion.stretch_rad == pytest.approx(motion.static_Nm)
    assert motion.seconds < 90.0
    for start_rad in (-0.69, 0.0, 0.69):
        placed = motion.placed(Mock(start_position_rad=start_rad, remarks=()))
        limits, way = placed.constants[0].limits, placed.table[:, 1]
        assert limits.frozen_max_rad == FROZEN_STRETCHES * motion.stretch_rad
        assert limits.frozen_torque_Nm > motion.static_Nm
        assert limits.swing.hunting_rad == 0.0  # no notice that it swings, which it does on purpose
        assert np.max(way) - np.min(way) < REACH * motion.stretch_rad
        assert np.min(way) > -0.74  # what the spring pushes against, while the joint stands
        assert np.max(way) < 0.74
        assert not np.any(placed.table[:, 2:])


FRICTION = shipped("precise").friction
assert FRICTION is not None
ONE_SIDED = FRICTION.model_copy(update={"negative": FRICTION.negative.model_copy(update={"ts_Nm": 0.0, "tc_Nm": 0.0})})


@pytest.mark.parametrize(
    "changes",
    [
        {"limits__position_min_rad": -0.2, "limits__position_max_rad": 0.2},
        {"joint__inertia_kgm2": 1e-4},
        {"loop__rate_Hz": 25.0, "margin__loop_delay_s": 0.1},
        {"friction": None, "control__feed_forward": "none"},
        {"friction": ONE_SIDED},
    ],
)
def test_where_it_cannot_be_it_is_left_out(changes: dict[str, Any]) -> None:
    config = shipped("precise").changed(**changes)
    assert presliding_motion(config) is None
    kept = measured_bristles(config, carrier())
    assert bristle_values(kept) == []
    assert "not measured: " in bristles_text(kept)


def carrier() -> Carrier:
    output = Output(quiet=True)
    return Carrier(output, TerminalConsent(output, assume_yes=True), None)


@pytest.mark.parametrize("fault", [Fault.LIMIT_CYCLE, Fault.VELOCITY_LIMIT])
def test_a_joint_that_breaks_loose_from_the_spring_has_no_bristles_that_are_measured(
    monkeypatch: pytest.MonkeyPatch, fault: Fault
) -> None:
    """Of a slow joint the speed at which it springs may be more than its limit; the tune goes on without them."""

    def run(*_: Any, also_faults: tuple[Fault, ...]) -> Carried:
        assert fault in also_faults
        return Carried(None, fault, FaultText("it moved", "cause", "next"), "")

    monkeypatch.setattr(Carrier, "run", run)
    assert measured_bristles(shipped("precise"), carrier()) == {"why": f"{fault.name} ({int(fault)}): it moved"}


@pytest.mark.parametrize(
    ("found", "written", "words"),
    [
        (Bristles(8e4, 7e4, 9e4), 8e4, "80000; 8e+04 Nm/rad, [7e+04..9e+04] 95 %"),
        (Bristles(2e6, 1e6, math.inf), 1.9e5, "[1e+06..] 95 %"),
        (Bristles(math.inf, 1e5, math.inf), 1e5, "stiffer than 1e+05 Nm/rad, which the encoder cannot tell from rigid"),
        (Bristles(math.inf, 3e6, math.inf), 1.9e5, "stiffer than 3e+06 Nm/rad"),
    ],
)
def test_what_is_written_is_no_stiffer_than_a_quarter_of_a_count(
    monkeypatch: pytest.MonkeyPatch, found: Bristles, written: float, words: str
) -> None:
    config: Config = shipped("precise").changed(encoder__counts_per_turn=2**14)
    monkeypatch.setattr(presliding, "bristles_of", lambda *_: found)
    monkeypatch.setattr(Carrier, "run", lambda *_, **__: Mock(text=None))
    stiffness, damping = bristle_values(measured_bristles(config, carrier()))
    assert stiffness.value == pytest.approx(written, rel=0.02)
    assert words in stiffness.source
    assert damping.value == pytest.approx(0.48 * math.sqrt(stiffness.value * config.joint.inertia_kgm2), rel=1e-4)
