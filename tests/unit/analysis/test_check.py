"""`check`: table, JSON, verdict, remedies and picture; where each assumption comes from; what a serial line carries."""

from __future__ import annotations

import io
import json
import math
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, JointctlError, MarginError, UsageError
from jointctl.firmware_py.observers import low_pass_gain
from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.analysis.linear_loop import CONTROLLERS, loop_settings
from jointctl.tools.analysis.loop_report import not_modelled
from jointctl.tools.analysis.margin_gate import coarsest, require_margin
from jointctl.tools.analysis.margins import phase_margin_deg
from jointctl.tools.configuration.config import Config, Learning
from jointctl.tools.configuration.conversions import joint_rad_per_count
from jointctl.tools.configuration.drive_section import require_simulated
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.experiments.scenarios import from_file
from jointctl.tools.output import Output
from jointctl.tools.verbs.check import check
from jointctl.tools.verbs.fault_campaign import fault_campaign
from tests.configurations import shipped, written
from tests.places import CONFIGS


# --- `check`: table, JSON, verdict, remedies and picture; where each assumption comes from ---
@pytest.fixture(autouse=True)
def wide_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that no cell is folded."""
    monkeypatch.setenv("COLUMNS", "250")


PAPER_SIMULATION = {"control__lyapunov_q": (2500.0,)}


def run_check(config: Config, delay_s: float | None = None, **options: Any) -> tuple[str, str, int]:
    """(stdout, stderr, exit code); a refusal keeps what was printed before it."""
    output = Output(json=options.pop("json", False), stdout=io.StringIO(), stderr=io.StringIO())
    try:
        code = check(config, output, delay_s, **options)
    except MarginError as error:
        output.error(error.message, error.hint)
        code = error.exit_code
    return output.stdout.getvalue(), output.stderr.getvalue(), code


def test_the_paper_on_its_platform_passes_and_everything_is_printed() -> None:
    shown, messages, code = run_check(shipped("paper"))
    assert code == 0
    for text in ("12680.357", "16.092", "6.709", "0.008536", "24.2 deg", "5.11 ms", "16.5 s", "2.40", "verdict", "ok"):
        assert text in shown
    assert "drive.rpdo_transmission_type = 1, synchronous" in shown
    assert 'control.feed_forward = "measured"' in messages


def motion_of(folder: Path, kind: str, move_s: float) -> dict[str, Any]:
    """From -0.5 to 0.5 rad in this time."""
    if kind == "table":
        times = [move_s * k / 50 for k in range(51)]
        rows = [f"{t},{-0.5 * math.cos(math.pi * t / move_s)}" for t in times]
        (folder / "way.csv").write_text("\n".join(["time_s,position_rad", *rows, ""]))
        return {"kind": "table", "duration_s": 9.0, "file": "way.csv"}
    return {"kind": "min_jerk", "duration_s": 9.0, "start_rad": -0.5, "target_rad": 0.5, "move_s": move_s}


@pytest.mark.parametrize(
    ("name", "kind", "short_s"), [("virtual", "min_jerk", 0.8), ("csp", "min_jerk", 0.8), ("virtual", "table", 0.7)]
)
def test_a_motion_that_could_not_be_braked_is_a_warning(tmp_path: Path, name: str, kind: str, short_s: float) -> None:
    for move_s, warned in ((short_s, True), (2.0, False)):
        changes = {"trajectory": motion_of(tmp_path, kind, move_s), "limits__velocity_max_radps": 3.0}
        config = load_config(written(tmp_path / "j.toml", name, **changes))
        shown, messages, code = run_check(config, json=True)
        assert any("sequence.brake_radps2 (=2), must be" in line for line in json.loads(shown)["warnings"]) is warned
        assert ("warning: at " in messages, code) == (warned, 0)


@pytest.mark.parametrize("kind", ["sine", "min_jerk", "table"])
@pytest.mark.parametrize(("share", "warned"), [(0.98, False), (1.02, True)])
def test_a_motion_that_needs_more_than_the_torque_limit_is_a_warning(
    tmp_path: Path, kind: str, share: float, warned: bool
) -> None:
    sine = {"kind": "sine", "duration_s": 9.0, "amplitude_rad": 0.35, "frequency_Hz": 0.5}
    peaks = {"sine": 0.35 * math.pi**2, "min_jerk": 10.0 / math.sqrt(3.0) / 4.0, "table": 0.5 * (math.pi / 2.0) ** 2}
    changes: dict[str, Any] = {
        "trajectory": sine if kind == "sine" else motion_of(tmp_path, kind, 2.0), "joint__gravity_Nm": 10.0,
        "joint__inertia_kgm2": share * 50.0 / peaks[kind], "limits__torque_max_Nm": 60.0,
        "sequence__brake_radps2": 0.9 * peaks[kind], "limits__velocity_max_radps": 2.0,
    }  # fmt: skip
    config = load_config(written(tmp_path / "j.toml", "virtual", **changes))
    found = json.loads(run_check(config, json=True, allow_low_margin=True)[0])["warnings"]
    assert any("the trajectory's largest acceleration" in line for line in found) is warned
    assert warned or not any("beside gravity" in line for line in found)


@pytest.mark.parametrize(
    ("rows", "words"),
    [("time_s,position_rad\n0,0\n1,nothing\n", "trajectory.file: "), ("time_s,position_rad\n0,0\n1,9\n", "9 rad")],
)
def test_a_motion_file_that_a_run_would_refuse_is_a_warning(tmp_path: Path, rows: str, words: str) -> None:
    (tmp_path / "way.csv").write_text(rows)
    changes = {"trajectory": {"kind": "table", "duration_s": 9.0, "file": "way.csv"}}
    shown, _, code = run_check(load_config(written(tmp_path / "j.toml", "virtual", **changes)), json=True)
    assert code == 0
    assert words in "\n".join(json.loads(shown)["warnings"])


def test_learning_and_contradictions_are_in_the_json_too() -> None:
    shown, messages, _ = run_check(shipped("precise"), json=True)
    found = json.loads(shown)
    assert 0.0 < found["learning"]["worst_factor"] < 1.0
    assert found["learning"]["worst_Hz"] > 0.0
    assert found["warnings"] == []
    assert "warning" not in messages
    shown, messages, code = run_check(shipped("virtual", joint__torque_constant_NmpA=20.0), json=True)
    found = json.loads(shown)
    assert found["learning"] is None
    assert any("joint.torque_constant_NmpA (=20" in line for line in found["warnings"])
    assert "warning: joint.torque_constant_NmpA" in messages
    assert code == 0


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_every_shipped_virtual_configuration_has_its_margin(name: str) -> None:
    found = require_margin(shipped(name))
    assert found.phase_margin_deg >= 20.0


def test_too_small_a_margin_is_refused_with_numbers() -> None:
    shown, messages, code = run_check(shipped("paper", **PAPER_SIMULATION))
    assert code == 9
    assert "too small" in shown
    assert "16.8 deg" in shown
    assert "phase margin (=16.8 deg) must be at least 20 deg: at 1000 Hz with 1 ms loop delay" in messages
    for remedy in (
        "control.lyapunov_q = 2170 (now 2500",
        "control.velocity_cutoff_Hz = ",
        "control.learning_rate = 69.5",
    ):
        assert remedy in messages


def test_what_is_sent_to_a_drive_that_closes_its_own_loop_is_what_its_eds_has(tmp_path: Path) -> None:
    both, *_ = run_check(shipped("csp"))
    assert "torque offset (60B2), velocity offset (60B1)" in both
    eds = tmp_path / "drive.eds"
    eds.write_text((CONFIGS / "virtual_joint.eds").read_text().replace("60B1", "60AF"))
    without, *_ = run_check(shipped("csp", drive__eds=str(eds)))
    assert re.search(r"sent besides the target\W+torque offset \(60B2\)\W+[^│]*drive.eds has no 60B1", without)


def test_an_unstable_loop_is_called_so_and_its_json_is_valid() -> None:
    shown, messages, code = run_check(shipped("paper"), 8e-3)
    assert code == 9
    assert "NO" in shown
    assert "the control loop is unstable" in messages
    margins = json.loads(run_check(shipped("paper"), 8e-3, json=True)[0])["margins"]
    assert (margins["stable"], margins["sensitivity_peak"]) == (False, None)  # infinite


def test_the_limit_is_met_exactly_at_the_boundary() -> None:
    margin_deg = require_margin(shipped("paper")).phase_margin_deg
    for above_deg, refused in ((-1e-9, False), (0.0, False), (1e-9, True), (0.1, True)):
        wanted = shipped("paper", margin__min_phase_margin_deg=margin_deg + above_deg)
        with pytest.raises(MarginError) if refused else nullcontext():
            require_margin(wanted)


def test_the_override_accepts_a_small_margin_but_never_an_unstable_loop_and_the_measured_delay_decides() -> None:
    config = shipped("paper", **PAPER_SIMULATION)
    with pytest.raises(MarginError, match=r"1\.5 ms loop delay"):
        require_margin(config, 1.5e-3)
    assert require_margin(config, 0.3e-3).phase_margin_deg > 20.0
    assert require_margin(config, allow_low_margin=True).stable
    shown, _, code = run_check(config, allow_low_margin=True)
    assert code == 0
    assert "below the minimum, accepted" in shown
    with pytest.raises(MarginError, match="unstable"):
        require_margin(config, 8e-3, allow_low_margin=True)


def test_a_loop_without_an_oscillating_mode_is_shown_without_nan() -> None:
    shown, _, code = run_check(shipped("realistic", control__kp=2400.0, control__kv=100.0))
    assert code == 9
    assert re.search(r"modes, no delay +│ none oscillates +│", shown)
    assert not re.search(r"\bnan\b", shown)


def test_json_holds_the_same_numbers() -> None:
    shown, _, code = run_check(shipped("paper", **PAPER_SIMULATION), json=True)
    data = json.loads(shown)
    assert code == 9
    assert data["verdict"] == "too small"
    assert data["margins"]["phase_margin_deg"] == pytest.approx(16.81, abs=0.01)
    assert data["margins"]["delay_margin_s"] == pytest.approx(3.21e-3, abs=1e-5)
    assert data["theory"]["p"] == pytest.approx([17611.607, 1.594388, 22.3499], rel=1e-6)
    assert data["theory"]["tight_bound_per_Nm"] == pytest.approx(0.0085, abs=5e-5)
    delay = next(a for a in data["assumptions"] if a["name"] == "loop delay")
    assert delay == {"name": "loop delay", "value": 1e-3, "unit": "s", "origin": delay["origin"]}
    assert all(remedy["phase_margin_deg"] >= 20.0 for remedy in data["remedies"])
    assert data["remedies"]


@pytest.mark.parametrize(("name", "error", "text"), [
    ("virtual.toml", UsageError, "must end in .png"), ("virtual.png", DataError, "is an input of this command"),
])  # fmt: skip
def test_a_picture_never_replaces_the_configuration(
    tmp_path: Path, name: str, error: type[JointctlError], text: str
) -> None:
    path = tmp_path / name
    content = shipped_config("virtual").read_bytes()
    path.write_bytes(content)
    with pytest.raises(error, match=text):
        check(load_config(path), Output(stdout=io.StringIO()), figure=path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("delay_s", [None, 8e-3])
def test_a_picture_is_written_for_stable_and_unstable_loops(tmp_path: Path, delay_s: float | None) -> None:
    path = tmp_path / "folder" / "loop.png"
    shown, _, _ = run_check(shipped("paper"), delay_s, figure=path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert "loop.png" in shown


@pytest.mark.parametrize(
    ("transmission_type", "periods"), [(0, 1.0), (1, 1.0), (2, 2.0), (240, 240.0), (254, 1.0), (255, 1.0)]
)
def test_the_assumed_delay_follows_the_rpdo(transmission_type: int, periods: float) -> None:
    config = shipped("paper", drive__rpdo_transmission_type=transmission_type)
    settings, assumptions = loop_settings(config)
    assert settings.delay_s == pytest.approx(periods * 1e-3)
    origin = assumptions[1].origin
    assert origin.startswith("assumed: ")
    assert ("asynchronous" in origin) is (transmission_type > 240)


@pytest.mark.parametrize("configured_s", [1.7e-3, 0.0])  # a delay of 0 is a value, not "unknown"
def test_measured_beats_configured_beats_assumed(configured_s: float) -> None:
    config = shipped("paper", margin__loop_delay_s=configured_s, margin__current_lag_s=0.9e-3)
    for measured_s, origin in ((None, "margin.loop_delay_s"), (2.5e-3, "measured")):
        settings, assumptions = loop_settings(config, measured_s)
        assert (settings.delay_s, settings.lag_s) == (measured_s or configured_s, 0.9e-3)
        assert assumptions[1].origin == origin


def test_a_negative_measured_delay_is_named() -> None:
    with pytest.raises(ConfigurationError, match=r"delay_s \(=-0\.001\) must be >= 0"):
        require_margin(shipped("paper"), -1e-3)


@pytest.mark.parametrize(
    ("settings", "delay_s", "remedy"),
    [
        ({"kind": "computed_torque"}, None, ""),
        ({"kind": "computed_torque_observer", "observer_radps": 60.0}, None, ""),
        ({"kind": "computed_torque_observer", "observer_radps": 200.0}, 3e-3, "control.observer_radps = "),
        ({"kind": "pid", "kp": 6075.0, "kv": 135.0, "ki": 91125.0}, None, ""),
        ({"kind": "pid", "kp": 6075.0, "kv": 135.0, "ki": 91125.0}, 5e-3, ", ki = "),
    ],
)
def test_the_other_kinds_can_be_checked_and_their_remedies_name_their_own_settings(
    settings: dict[str, Any], delay_s: float | None, remedy: str
) -> None:
    assert set(CONTROLLERS) == set(ControllerKind) - {ControllerKind.OUTSIDE}  # the torque is given: nothing to check
    config = shipped("paper", control=settings)
    shown, messages, code = run_check(config, delay_s)
    assert code == (9 if remedy else 0)
    assert remedy in messages
    assert "eigenvalues of P" not in shown


def test_widths_and_q_pairs_arrive() -> None:
    widths = tuple(0.01 * (i + 1) for i in range(15))
    settings, _ = loop_settings(shipped("paper", control__widths=widths, control__lyapunov_q=(1000.0, 20.0)))
    assert settings.widths == widths
    assert settings.q == (1000.0, 20.0)
    assert len(settings.centres) == 15
    assert phase_margin_deg(settings) > 0.0


def test_what_the_model_leaves_out_is_said() -> None:
    config = shipped("paper", joint__gravity_Nm=5.0, joint__coriolis_Nmspr=0.1, control__dead_zone_rad=1e-4)
    assert [text.split(" ")[0] for text in not_modelled(config)] == [
        "control.feed_forward", "joint.gravity_Nm", "joint.coriolis_Nmspr", "control.dead_zone_rad",
    ]  # fmt: skip
    assert not_modelled(shipped("paper", control__feed_forward="desired")) == []


@pytest.mark.parametrize(
    ("bits", "side", "warned"), [(14, "joint", True), (16, "joint", True), (17, "joint", False), (14, "motor", False)]
)
def test_an_encoder_too_coarse_for_the_gains_is_told(bits: int, side: str, warned: bool) -> None:
    config = shipped("precise", encoder__counts_per_turn=2**bits, encoder__side=side)
    assert any("chatter" in text for text in not_modelled(config)) is warned


@pytest.mark.parametrize(("bits", "cutoff_Hz"), [(14, 40.0), (15, 50.0), (16, 80.0)])
def test_with_the_kalman_filter_the_same_encoder_is_fine_enough(bits: int, cutoff_Hz: float) -> None:
    config = shipped(
        "precise", encoder__counts_per_turn=2**bits, control__velocity_filter="kalman",
        control__velocity_cutoff_Hz=cutoff_Hz, control__kp=2500.0, control__kv=100.0, control__observer_radps=50.0,
    )  # fmt: skip
    assert not any("chatter" in text for text in not_modelled(config))
    config = config.changed(control__velocity_cutoff_Hz=400.0, encoder__counts_per_turn=2**12)
    assert any("chatter" in text for text in not_modelled(config))


def test_a_soft_reducer_is_told_with_its_resonance_and_of_a_real_joint_nobody_knows_it() -> None:
    soft = {"flexible": True, "motor_side_inertia_kgm2": 1.05, "reducer_stiffness_Nmprad": 1.05 / 2 * 6283.2**2 / 1e4}
    for changes, words in (
        ({}, []),
        ({f"virtual__{key}": value for key, value in soft.items()}, ["the reducer resonates at 10.0 Hz"]),
        ({"virtual": None}, ["flexibility of the reducer"]),
    ):
        texts = [text for text in not_modelled(shipped("precise", **changes)) if "reducer" in text]
        assert len(texts) == len(words)
        assert all(word in text for word, text in zip(words, texts, strict=True))


# --- `jointctl check` on a serial line: a rate that the line cannot carry is refused, and the advice passes ---
SHIPPED = shipped_config("elmo_serial").read_text()


def checked(tmp_path: Path, **changes: float) -> str:
    """What `check` prints for the shipped configuration with other values."""
    text = SHIPPED
    for key, value in changes.items():
        text, count = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value:g} ", text, count=1, flags=re.MULTILINE)
        assert count == 1, key
    path = tmp_path / "joint.toml"
    path.write_text(re.sub(r"^rate_Hz = (\d+) ", r"rate_Hz = \1.0 ", text, flags=re.MULTILINE))
    out = io.StringIO()
    check(load_config(path), Output(stdout=out, stderr=io.StringIO()))
    return out.getvalue()


def test_the_shipped_one_passes_and_tells_what_the_line_carries(tmp_path: Path) -> None:
    told = checked(tmp_path)
    assert "62% of the line; up to 202 Hz at 115200 baud" in told


@pytest.mark.parametrize(("baud_rate", "refused"), [(57_600, True), (115_200, False), (230_400, False)])
def test_another_baud_rate_may_not_carry_the_rate(tmp_path: Path, baud_rate: int, refused: bool) -> None:
    if not refused:
        assert f"at {baud_rate} baud" in checked(tmp_path, baud_rate_bitps=baud_rate)
        return
    with pytest.raises(ConfigurationError, match=r"loop.rate_Hz \(=125\) must be at most 101 at") as caught:
        checked(tmp_path, baud_rate_bitps=baud_rate)
    hint = caught.value.hint
    assert hint.startswith("with loop.rate_Hz = 90 and control.velocity_cutoff_Hz = 43 the gains need a slower loop")
    advice = {key: float(value) for key, value in re.findall(r"(\w+) = ([\d.]+)", hint)}
    told = checked(tmp_path, baud_rate_bitps=baud_rate, position_jump_max_rad=0.04, **advice)
    assert "verdict" in told
    with pytest.raises(MarginError, match="phase margin"):  # the twin: the rate alone is not enough
        checked(
            tmp_path, baud_rate_bitps=baud_rate, position_jump_max_rad=0.04,
            rate_Hz=advice["rate_Hz"], velocity_cutoff_Hz=advice["velocity_cutoff_Hz"],
        )  # fmt: skip


def test_a_rate_that_leaves_the_gains_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        checked(tmp_path, rate_Hz=203)
    assert re.match(r"with loop.rate_Hz = 181 the gains keep \d\d deg", caught.value.hint)


def test_what_is_simulated_in_lockstep_is_refused_in_one_line() -> None:
    config = shipped("elmo_serial")
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for fault-campaign'):
        fault_campaign(config, Output())
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for study'):
        from_file("elmo_serial")
    require_simulated(shipped("virtual"), "fault-campaign")  # the twin


# --- a joint whose reducer is not rigid ---
def rigid_law_behind_a_reducer(encoder: str) -> Config:
    """The law of precise.toml on the joint of realistic.toml."""
    config = shipped("realistic", control=shipped("precise").control)
    assert config.joint_encoder is not None
    return config.changed(joint_encoder__law=encoder)


def test_the_worst_of_all_joints_is_judged_and_named(tmp_path: Path) -> None:
    shown, messages, code = run_check(shipped("realistic"), figure=tmp_path / "loop.png")
    assert code == 0
    assert re.search(r"worst case +│ link inertia x [01]\.[74], stiffness x [01]\.[73], without friction", shown)
    assert "of 18 joints" in shown
    assert "35.6 Hz" in shown  # the resonance
    for payload in ("0.5", "2"):
        assert f"outside margin.payload_range, link inertia x {payload}: phase margin" in messages
    assert (tmp_path / "loop.png").stat().st_size > 1000


def test_a_law_for_a_rigid_joint_is_refused_on_the_link_of_a_soft_reducer() -> None:
    _, messages, code = run_check(rigid_law_behind_a_reducer("joint_encoder"))
    assert code == 9
    assert "the control loop is unstable" in messages
    assert "worst case: " in messages
    # its twin: a softer law of that kind on the motor's encoder
    motor = rigid_law_behind_a_reducer("encoder")
    soft = {"kp": 300.0, "kv": 20.0, "observer_radps": 40.0, "velocity_cutoff_Hz": 300.0, "learning": None}
    assert run_check(motor.changed(control=soft))[2] == 0


def test_a_wider_payload_range_is_judged_and_no_longer_a_warning() -> None:
    narrow, _ = loop_settings(shipped("realistic"))
    wide, _ = loop_settings(shipped("realistic", margin__payload_range=(0.4, 2.5)))
    assert phase_margin_deg(wide) < phase_margin_deg(narrow)
    assert "outside margin" not in run_check(shipped("realistic", margin__payload_range=(0.4, 2.5)))[1]


def test_friction_that_holds_is_looked_at_where_its_bristles_are_known() -> None:
    config = shipped("realistic")
    assert config.friction is not None
    names = [joint.name for joint in loop_settings(config)[0].joints]
    assert sum("held by friction" in name for name in names) == 9
    without = config.changed(friction__lugre=None)
    assert not any("held" in joint.name for joint in loop_settings(without)[0].joints)


def test_a_remedy_does_for_every_joint() -> None:
    config = shipped("realistic", control__kv=90.0, control__kp=2500.0, margin__min_phase_margin_deg=40.0)
    _, messages, code = run_check(config)
    assert code == 9
    found = re.search(r"a slower loop: control\.kp = ([\d.e+]+), kv = ([\d.]+), observer_radps = ([\d.]+)", messages)
    assert found is not None
    kp, kv, observer = (float(number) for number in found.groups())
    slower = shipped("realistic", control__kp=kp, control__kv=kv, control__observer_radps=observer)
    assert phase_margin_deg(loop_settings(slower)[0]) >= 39.9  # the numbers of the message are rounded


def test_learning_is_judged_with_the_worst_joint() -> None:
    from jointctl.tools.analysis.margin_gate import learning_of

    good = Learning(gain=0.6, error_gain_ps2=300.0, lead_cycles=10, half_width_cycles=10)
    for learning, converges in ((good, True), (good.model_copy(update={"error_gain_ps2": 60000.0}), False)):
        config = shipped("realistic", control__learning=learning)
        found = learning_of(config, loop_settings(config)[0])
        assert found is not None
        assert (found.worst_factor < 1.0) is converges
        out, _, _ = run_check(config)
        assert (": diverges" in out) is not converges


KEYS = {"kp", "kv", "observer_radps", "observer_delay_cycles", "velocity_cutoff_Hz"}


def test_gains_are_chosen_on_request_for_the_law_of_the_file() -> None:
    shown, _, _ = run_check(shipped("realistic", joint_encoder=None, encoder__side="joint"), choose_gains=True)
    assert re.search(r"chosen gains +│ kp = [\d.]+, kv = [\d.]+, observer_radps = [\d.]+, ", shown)
    assert re.search(r"velocity_cutoff_Hz = \d\.\d+ ", shown)  # the resonance lies between
    impossible = shipped("precise", margin__min_phase_margin_deg=80.0)
    shown, _, code = run_check(impossible, choose_gains=True)
    assert (code, "NOT what is asked for" in shown) == (9, True)
    shown, _, code = run_check(shipped("paper"), choose_gains=True)
    assert re.search(r"chosen gains +│ kp = [\d.]+, kv = [\d.]+, lyapunov_q = [\d.]+ ", shown)
    shown, _, code = run_check(shipped("precise"), choose_gains=True, json=True)
    chosen = json.loads(shown)["chosen_gains"]
    assert (code, chosen["met"], set(chosen["changes"])) == (0, True, KEYS)
    assert chosen["phase_margin_deg"] > 30.0
    other = shipped("paper", control__kind="computed_torque")
    with pytest.raises(ConfigurationError, match=r"gains are chosen for control.kind \(=computed_torque\) of flexible"):
        run_check(other, choose_gains=True)


@pytest.mark.slow("searches of soft joints")
def test_gains_that_are_chosen_behind_a_reducer_have_what_that_law_has_besides() -> None:
    shown, _, code = run_check(shipped("realistic"), choose_gains=True, json=True)
    chosen = json.loads(shown)["chosen_gains"]
    assert (code, chosen["met"], set(chosen["changes"])) == (0, True, {*KEYS, "link_cutoff_Hz"})
    assert chosen["phase_margin_deg"] > 30.0
    shown, *_ = run_check(rigid_law_behind_a_reducer("encoder"), choose_gains=True, json=True)
    chosen = json.loads(shown)["chosen_gains"]
    assert (chosen["met"], set(chosen["changes"])) == (True, {*KEYS, "learning"})


def test_a_torque_that_does_not_hold_the_joint_is_no_chatter() -> None:
    """Without friction and gravity the encoder's step alone counts, which is small."""
    config = shipped("precise", control__learning=None, limits__torque_max_Nm=18.0)
    with pytest.raises(MarginError, match=r"friction and gravity need 19\.1 Nm, .* \(=18\) must be more"):
        require_margin(config)
    assert require_margin(config, allow_low_margin=True).stable


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "ok"),
        ({"encoder__counts_per_turn": 2**15}, "the torque would chatter at its limit"),
        ({"joint__gravity_Nm": 59.0}, "friction and gravity need 78.1 Nm, limits.torque_max_Nm (=60) must be more"),
        ({"control__learning": Learning(gain=1.0, error_gain_ps2=6e4, lead_cycles=10, half_width_cycles=10)},
         "iterative learning would diverge"),
    ],
)  # fmt: skip
def test_the_verdict_is_that_of_the_exit_code(changes: dict[str, Any], verdict: str) -> None:
    """It was "ok" beside an error and exit code 9 where the margins alone are enough."""
    shown, _, code = run_check(shipped("precise", **changes), json=True)
    assert (json.loads(shown)["verdict"], code) == (verdict, 0 if verdict == "ok" else 9)


KALMAN = {"control__velocity_filter": "kalman", "control__velocity_cutoff_Hz": 60.0}


# --- a torque that an encoder moves to its limit is refused; on the simulated joint it is a limit cycle ---
@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({"encoder__counts_per_turn": 2**15}, True),  # `faults/test_limit_cycle.py`: "coarse encoder"
        ({"encoder__counts_per_turn": 2**16}, False),  # and its twin that is only noisy
        ({"encoder__counts_per_turn": 2**15, **KALMAN}, False),
        ({"limits__torque_max_Nm": 32.0}, False),
        ({"encoder__counts_per_turn": 2**17, "limits__torque_max_Nm": 32.0}, True),  # 13.3 Nm on top of 19
    ],
)  # fmt: skip
def test_what_would_chatter_at_the_torque_limit_is_refused(changes: dict[str, Any], refused: bool) -> None:
    config = shipped("precise", control__learning=None, **changes)
    messages, code = run_check(config)[1:]
    assert ("the torque would chatter at its limit: one count" in messages) is refused
    assert code == (9 if refused else 0)
    with pytest.raises(MarginError, match="chatter") if refused else nullcontext():
        require_margin(config)
    assert require_margin(config, allow_low_margin=True).stable


@pytest.mark.parametrize(
    ("counts", "named", "cure"),
    [
        ({"joint_encoder__counts_per_turn": 2**16}, "", ""),
        ({"joint_encoder__counts_per_turn": 2**15}, "joint_encoder.counts_per_turn (=32768)", "radps and link_cutoff"),
        ({"encoder__counts_per_turn": 2**10}, "encoder.counts_per_turn (=1024)", "observer_radps and velocity_cutoff"),
    ],
)
def test_the_coarse_encoder_of_a_flexible_joint_is_named(counts: dict[str, int], named: str, cure: str) -> None:
    """It was always [encoder], from 15 Nm a count on, with a filter that this law does not have as the remedy."""
    said = [line for line in not_modelled(shipped("realistic", **counts)) if "it will chatter" in line]
    assert all(line.startswith(f"{named}: one count") and cure in line and "kalman" not in line for line in said)
    assert len(said) == bool(named)


def test_the_step_of_a_count_is_that_of_position_rate_and_observer() -> None:
    precise = shipped("precise", encoder__counts_per_turn=2**17)
    slope_1ps = low_pass_gain(200.0, 1e-3) * 1000.0
    expected = 2.1 * (3600.0 + (120.0 + 60.0) * slope_1ps) * math.tau / 2**17
    assert coarsest(precise, loop_settings(precise)[0])[0] == pytest.approx(expected)
    two = shipped("realistic", joint_encoder__counts_per_turn=2**24)  # the motor's encoder is the coarser one
    loop, _ = loop_settings(two)
    slope_1ps = low_pass_gain(loop.cutoff_Hz, 1e-3) * 1000.0
    kept = math.exp(-loop.twist_radps * 1e-3)
    of_motor = loop.inertia_kgm2 * (loop.kp * kept + loop.kv * slope_1ps)
    of_motor += loop.observer_radps * loop.motor_inertia_kgm2 * slope_1ps
    assert coarsest(two, loop)[0] == pytest.approx(of_motor * abs(joint_rad_per_count(two)))
