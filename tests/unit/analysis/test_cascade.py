"""Margins of the loops that a drive closes itself, and what `check` says of them."""

from __future__ import annotations

import contextlib
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from jointctl.drivers.errors import ConfigurationError, MarginError, UsageError
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.margin_gate import cascade_margins, cascade_text, require_cascade
from jointctl.tools.configuration.canopen import CanopenSection, cyclic_bus_load, rpdo_bytes
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.verbs.check import check
from tests.configurations import load, own_loop, problems, shipped, written
from tests.places import CONFIGS

CSP = (CONFIGS / "csp.toml").read_text()


def drive_of(config: Config) -> CanopenSection:
    assert isinstance(config.drive, CanopenSection)
    return config.drive


# --- margins ---
def test_without_delay_and_lag_the_velocity_loop_is_the_textbook_one() -> None:
    config = own_loop(loop_rate_Hz=1e5).changed(margin__current_lag_s=0.0)
    velocity = cascade_margins(config, 1e-3)[0]
    inertia, gain, integral = config.joint.inertia_kgm2, 200.0, 10000.0
    omega = math.tau * velocity.crossover_Hz
    assert abs((gain + integral / (1j * omega)) / (1j * omega * inertia)) == pytest.approx(1.0, abs=2e-3)
    late_deg = math.degrees(omega * 1.5e-5)
    assert velocity.phase_margin_deg == pytest.approx(
        math.degrees(math.atan(omega * gain / integral)) - late_deg, abs=0.1
    )


@pytest.mark.parametrize("share", [0.97, 1.03])
@pytest.mark.parametrize("loop", [0, 1])
def test_the_gain_margin_is_where_the_sampled_loop_becomes_unstable(loop: int, share: float) -> None:
    """Simulated with the drive's period: zero-order hold, one period to compute."""
    config = own_loop(loop_rate_Hz=2000.0, velocity_gain_Nmspr=600.0)
    if loop:
        config = own_loop(loop_rate_Hz=2000.0, velocity_gain_Nmspr=600.0, position_gain_ps=60.0)
    config = config.changed(margin__current_lag_s=0.5e-3)
    factor = share * cascade_margins(config, 1e-3)[loop].gain_margin_up
    gains = [600.0, 10000.0, drive_of(config).cascade.position_gain_ps]  # type: ignore[union-attr]
    if loop == 0:
        gains = [factor * gains[0], factor * gains[1], 0.0]
    else:
        gains[2] = (gains[2] or 0.0) * factor
    grows = _simulated(config, gains, 4000) > 1.0
    assert grows == (share > 1.0)


def _simulated(config: Config, gains: list[Any], steps: int) -> float:
    """Growth of the error over the second half of a run from a small displacement."""
    period = 1.0 / drive_of(config).cascade.loop_rate_Hz  # type: ignore[union-attr]
    lag, inertia, reducer = config.margin.current_lag_s, config.joint.inertia_kgm2, config.reducer
    if reducer is None:
        a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0 / inertia], [0.0, 0.0, -1.0 / lag]])
    else:  # the shaft that the encoder sits on, and the other one
        masses = [reducer.motor_inertia_kgm2, inertia - reducer.motor_inertia_kgm2]
        own, other = masses if config.encoder.side == "motor" else masses[::-1]
        k, d = reducer.loop_stiffness_Nmprad or reducer.stiffness_Nmprad, reducer.damping_Nmspr
        a = np.zeros((5, 5))
        a[0, 1] = a[2, 3] = 1.0
        a[1, :4], a[3, :4] = np.array([-k, -d, k, d]) / own, np.array([k, d, -k, -d]) / other
        a[1 if config.encoder.side == "motor" else 3, 4], a[4, 4] = 1.0 / masses[0], -1.0 / lag
    b = np.zeros((len(a), 1))
    b[-1] = 1.0 / lag
    ad, bd, *_ = signal.cont2discrete((a, b, np.eye(len(a)), np.zeros((len(a), 1))), period)
    x, integral, late = np.zeros(len(a)), 0.0, 0.0
    x[:2] = 1e-3
    sizes = []
    for _ in range(steps):
        error = gains[2] * -x[0] - x[1]
        torque, integral = gains[0] * error + integral, integral + gains[1] * error * period
        x, late = ad @ x + bd[:, 0] * late, torque
        sizes.append(abs(x[1]))
        if sizes[-1] > 1e12:
            return math.inf
    return max(sizes[3 * steps // 4 :]) / max(sizes[steps // 4 : steps // 2])


def soft_loop(side: str, mode: str = "csp", **cascade: float) -> Config:
    """The joint that realistic.toml believes, and it alone, without friction; 0.5 ms lag."""
    alone = {"margin__payload_range": (1.0, 1.0), "margin__stiffness_error": 0.0, "friction__lugre": None}
    config = shipped("realistic", joint_encoder=None, encoder__side=side, **alone)
    gains = {"velocity_gain_Nmspr": 150.0, "velocity_integral_Nmprad": 5000.0, "position_gain_ps": 20.0, **cascade}
    return config.changed(drive=own_loop(mode, **gains).drive)


@pytest.mark.parametrize("share", [0.97, 1.03])
@pytest.mark.parametrize(("side", "slower"), [("motor", 0.05), ("joint", 0.002)])
def test_with_a_reducer_the_gain_margin_is_that_of_two_masses(side: str, slower: float, share: float) -> None:
    config = soft_loop(
        side, loop_rate_Hz=2000.0, position_gain_ps=1.0, velocity_gain_Nmspr=slower * 800.0,
        velocity_integral_Nmprad=slower * 100.0,
    )  # fmt: skip
    velocity = cascade_margins(config, 1e-3)[0]
    assert velocity.stable
    factor = share * velocity.gain_margin_up
    grows = _simulated(config, [factor * slower * 800.0, factor * slower * 100.0, 0.0], 8000) > 1.0
    assert grows == (share > 1.0)


def test_a_drive_that_closes_its_loops_over_a_soft_reducer_is_refused() -> None:
    """Each was called stable with 60 deg, and ends by LIMIT_CYCLE in simulation."""
    for mode in ("csp", "csv"):
        assert require_cascade(soft_loop("motor", mode), 1e-3)
        with pytest.raises(MarginError, match=r"velocity loop \(=-.* deg, unstable\) must be .*; worst case: without"):
            require_cascade(soft_loop("joint", mode), 1e-3, allow_low_margin=True)
    out = io.StringIO()
    with pytest.raises(MarginError):
        check(soft_loop("joint"), Output(stdout=out, stderr=io.StringIO()))
    assert "UNSTABLE" in out.getvalue()
    shipped_one = shipped("realistic")
    stiff = own_loop("csv", velocity_gain_Nmspr=500.0, velocity_integral_Nmprad=40_000.0, position_gain_ps=50.0)
    with pytest.raises(MarginError, match="position loop"):  # which reads the link
        require_cascade(shipped_one.changed(drive=stiff.drive), 1e-3)


def test_a_loop_that_is_closed_here_is_not_blamed_on_the_drives_gains() -> None:
    """Where the drive's velocity loop is not known it is taken for the quickest."""
    soft = shipped("realistic")
    known = {"velocity_gain_Nmspr": 500.0, "velocity_integral_Nmprad": 40_000.0}
    for gains in (known, dict.fromkeys(known)):
        config = soft.changed(drive=own_loop("csv", position_gain_ps=50.0, **gains).drive)
        with pytest.raises(MarginError, match="position loop") as caught:
            require_cascade(config, 1e-3)
        assert caught.value.hint.startswith("a lower drive.cascade.position_gain_ps (now 50)")
        assert ("infinitely quick" in caught.value.hint) == (gains is not known)
    with pytest.raises(MarginError, match="position loop") as caught:
        require_cascade(own_loop(position_gain_ps=900.0), 1e-3)
    assert "those of the drive with its maker's software" in caught.value.hint


def test_csv_closes_the_position_loop_here_and_feels_our_delay() -> None:
    quick, slow = (cascade_margins(own_loop("csv"), delay)[1].phase_margin_deg for delay in (1e-3, 5e-3))
    assert slow < quick
    alone = [cascade_margins(own_loop("csp"), delay)[1] for delay in (1e-3, 5e-3)]
    assert alone[0] == alone[1]


# --- what is said and refused ---
def test_nothing_is_said_of_gains_that_are_not_given() -> None:
    config = own_loop(velocity_gain_Nmspr=None, velocity_integral_Nmprad=None)
    assert cascade_margins(config, 1e-3) == []
    assert "gains are not given" in cascade_text(config, 1e-3)
    both = own_loop("csv", velocity_gain_Nmspr=None, velocity_integral_Nmprad=None)
    assert [loop.name for loop in cascade_margins(both, 1e-3)] == ["position loop"]


def test_a_cascade_without_its_margin_is_refused_and_an_unstable_one_always() -> None:
    config = own_loop(velocity_integral_Nmprad=200_000.0, position_gain_ps=None)
    with pytest.raises(MarginError, match=r"velocity loop \(=.* deg\) must be at least 15 deg"):
        require_cascade(config, 1e-3)
    assert require_cascade(config, 1e-3, allow_low_margin=True)
    with pytest.raises(MarginError, match="unstable"):
        require_cascade(own_loop(position_gain_ps=900.0), 1e-3, allow_low_margin=True)


@pytest.mark.parametrize(("share", "stable"), [(0.9, False), (1.1, True)])
def test_a_velocity_loop_of_less_lead_than_lag_is_unstable(share: float, stable: bool) -> None:
    """The two integrators take all of the phase: Kv/Ki must be more than the drive's delay and lag."""
    gain = share * (1.5 / 2000.0 + 1e-3) * 1000.0
    config = own_loop(loop_rate_Hz=2000.0, velocity_gain_Nmspr=gain, velocity_integral_Nmprad=1000.0)
    config = config.changed(margin__current_lag_s=1e-3)
    found = cascade_margins(config, 1e-3)[0]
    assert (found.stable, found.phase_margin_deg > 0.0) == (stable, stable)


def test_check_reports_both_loops_and_the_lead() -> None:
    out, err = io.StringIO(), io.StringIO()
    assert check(own_loop(), Output(json=True, stdout=out, stderr=err)) == 0
    data = json.loads(out.getvalue())
    assert [loop["name"] for loop in data["loops"]] == ["velocity loop", "position loop"]
    assert (data["mode"], data["lead_s"]) == ("csp", 0.002)
    assert "filters" in err.getvalue()
    with pytest.raises(UsageError, match="--choose-gains"):
        check(own_loop(), Output(json=True, stdout=out, stderr=err), choose_gains=True)


@pytest.mark.parametrize(("kind", "periods"), [(0, 2.0), (1, 2.0), (3, 4.0), (240, 241.0), (254, 1.0), (255, 1.0)])
def test_the_lead_is_until_the_target_takes_effect(kind: int, periods: float) -> None:
    drive = drive_of(own_loop()).model_copy(update={"rpdo_transmission_type": kind})
    sent, chosen = drive.sent_with_target(500.0), drive_of(own_loop(lead_s=0.004)).sent_with_target(500.0)
    assert sent is not None
    assert chosen is not None
    assert (sent.lead_s, chosen.lead_s) == (pytest.approx(periods / 500.0), 0.004)
    assert drive_of(shipped("virtual")).sent_with_target(500.0) is None


@pytest.mark.parametrize(
    ("mode", "cascade", "lengths"),
    [("csp", {}, (8, 4)), ("csp", {"velocity_offset": False}, (8,)), ("csv", {}, (8,)),
     ("csv", {"torque_offset": False}, (6,))],
)  # fmt: skip
def test_the_frames_of_a_cycle(mode: str, cascade: dict[str, Any], lengths: tuple[int, ...]) -> None:
    config = own_loop(mode, **cascade)
    assert rpdo_bytes(drive_of(config)) == lengths
    assert cyclic_bus_load(config) > cyclic_bus_load(shipped("virtual"))


@pytest.mark.parametrize("base", ["csp", "virtual"])
@pytest.mark.parametrize(("option", "refused"), [(4, False), (5, True), (8, True)])
def test_a_quick_stop_that_keeps_the_power_is_refused(tmp_path: Path, base: str, option: int, refused: bool) -> None:
    """Its last controlword may enable such a drive again: with the computer dead the virtual one kept its torque."""
    path = written(tmp_path / "joint.toml", base, drive__quick_stop_option=option)
    with pytest.raises(ConfigurationError, match=r"must be in \[0..4\]") if refused else contextlib.nullcontext():
        assert load_config(path).drive.quick_stop_option == option  # type: ignore[attr-defined]


# --- combinations that cannot be ---
@pytest.mark.parametrize(
    ("pattern", "line", "words"),
    [
        (r'kind = "computed_torque"', 'kind = "computed_torque_rbf"', "control.kind (=computed_torque_rbf) must be"),
        (r'feed_forward = "lugre_desired"', 'feed_forward = "measured"', "control.feed_forward (=measured) must be"),
        (r"quick_stop_option = 2", "quick_stop_option = 6", "drive.quick_stop_option (=6) must be in [0..4]"),
        (
            r'mode = "csp"',
            'mode = "cst"',
            '[drive.cascade] must be left out unless drive.mode (=cst) is "csp" or "csv"',
        ),
        (r"velocity_gain_Nmspr = 200.0", "", "velocity_gain_Nmspr and velocity_integral_Nmprad must be given together"),
        (r"position_gain_ps = 30.0", "position_gain_ps = 0", "position_gain_ps (=0) must be in (0..1000]"),
        (r"torque_offset = true", "lead_s = 0.2", 'lead_s (=0.2) must be "auto" or in [0..0.1]'),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path: Any, pattern: str, line: str, words: str) -> None:
    found = problems(tmp_path, pattern, line, CSP)
    assert any(words in text for text in found), found


def test_csv_needs_the_gain_of_the_position_loop_and_a_section(tmp_path: Any) -> None:
    csv = CSP.replace('mode = "csp"', 'mode = "csv"')
    assert load(tmp_path, text=csv)
    found = problems(tmp_path, r"position_gain_ps = 30.0", "", csv)
    assert any("drive.cascade.position_gain_ps is missing" in text for text in found)
    virtual = (CONFIGS / "virtual.toml").read_text()
    assert any(
        "[drive.cascade] is missing" in text for text in problems(tmp_path, 'mode = "cst"', 'mode = "csv"', virtual)
    )


def test_a_serial_drive_has_no_such_mode(tmp_path: Any) -> None:
    text = (CONFIGS / "elmo_serial.toml").read_text()
    found = problems(tmp_path, r'kind = "elmo_serial"', 'kind = "elmo_serial"\nmode = "csp"', text)
    assert any("drive.mode" in line for line in found)


@pytest.mark.parametrize(("minimum_deg", "verdict"), [(60.0, "ok"), (61.0, "too small")])
def test_check_has_a_verdict_on_the_drives_loops(minimum_deg: float, verdict: str) -> None:
    said = io.StringIO()
    config = shipped("csp", margin__min_phase_margin_deg=minimum_deg)
    with contextlib.nullcontext() if verdict == "ok" else pytest.raises(MarginError):
        check(config, Output(stdout=said, stderr=io.StringIO()))
    (row,) = (line for line in said.getvalue().splitlines() if "verdict" in line)
    assert f" {verdict} " in row
    assert f"at least {minimum_deg:g} deg wanted" in row


@pytest.mark.parametrize(("gravity_Nm", "too_much"), [(40.0, False), (-40.0, False), (41.5, True), (-41.5, True)])
def test_gravity_and_friction_that_take_all_torque_are_named(gravity_Nm: float, too_much: bool) -> None:
    """In torque mode the gate refuses 19 Nm of friction beside them; `check` of CSP said nothing of it."""
    said = io.StringIO()
    assert check(shipped("csp", joint__gravity_Nm=gravity_Nm), Output(stdout=io.StringIO(), stderr=said)) == 0
    words = "warning: friction and gravity need 60.6 Nm, limits.torque_max_Nm (=60) must be more"
    assert (words in said.getvalue()) is too_much


# --- a reducer that is not rigid: what the twist is away from the expected one is taken off the target ---
@pytest.mark.parametrize(("twist_radps", "swings"), [(60.0, True), (10.0, False)])
def test_a_twist_correction_that_meets_the_links_resonance_is_refused(twist_radps: float, swings: bool) -> None:
    """The drive's loops alone have 50 deg and more, and the joint ended by LIMIT_CYCLE."""
    slopes = {"stiffness_Nmprad": 5e3, "knees_Nm": (2.0, 6.9), "stiffness_beyond_Nmprad": (7.5e3, 9e3)}
    truth = {f"virtual__reducer_{key}": value for key, value in slopes.items()}
    soft = shipped(
        "realistic", **truth, reducer=slopes,
        reducer__loop_stiffness_Nmprad=7750.0, reducer__damping_Nmspr=2.1, virtual__reducer_damping_Nmspr=2.1,
        reducer__motor_inertia_kgm2=0.24, joint__inertia_kgm2=0.8, virtual__motor_side_inertia_kgm2=0.24,
        virtual__command_delay_s=0.9e-3, margin__loop_delay_s=1.9e-3, control__twist_radps=twist_radps,
        virtual__link_friction_share=0.05, trajectory__duration_s=8.0,
    )  # fmt: skip
    cascade = {"position_gain_ps": 40.0, "velocity_gain_Nmspr": 160.0, "velocity_integral_Nmprad": 8000.0}
    section = drive_of(own_loop(**cascade))
    config = soft.changed(drive__mode="csp", drive__cascade=section.cascade)
    *own, twist = cascade_margins(config, 1.9e-3)
    assert all(loop.stable and loop.phase_margin_deg > 45.0 for loop in own)
    assert twist.stable is not swings
    run = LockstepJoint(config).run()
    assert run.fault is (Fault.LIMIT_CYCLE if swings else Fault.NONE)
    if swings:
        with pytest.raises(MarginError, match=r"twist correction .*unstable") as caught:
            require_cascade(config, 1.9e-3)
        assert caught.value.hint == "a lower control.twist_radps (now 60)"
    else:
        assert "twist correction with a gain below 1" in cascade_text(config, 1.9e-3)
