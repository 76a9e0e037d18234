"""`check`: table, JSON, verdict, remedies and picture; where each assumption comes from; what a serial line carries."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DataError, JointctlError, MarginError, UsageError
from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.analysis.linear_loop import CONTROLLERS
from jointctl.tools.analysis.loop_settings import loop_settings, not_modelled
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.analysis.margins import phase_margin_deg
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import require_simulated
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.experiments.controllers import from_file
from jointctl.tools.output import Output
from jointctl.tools.verbs.check import check
from jointctl.tools.verbs.fault_campaign import fault_campaign


# --- `check`: table, JSON, verdict, remedies and picture; where each assumption comes from ---
@pytest.fixture(autouse=True)
def wide_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that no cell is folded."""
    monkeypatch.setenv("COLUMNS", "250")


def changed(section: str, config: Config | None = None, **values: Any) -> Config:
    """The paper's configuration with these values in one section."""
    config = load_config(shipped_config("paper")) if config is None else config
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


PAPER_SIMULATION = {"lyapunov_q": (2500.0,)}


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
    shown, messages, code = run_check(load_config(shipped_config("paper")))
    assert code == 0
    for text in ("12680.357", "16.092", "6.709", "0.008536", "24.2 deg", "5.11 ms", "16.5 s", "2.40", "verdict", "ok"):
        assert text in shown
    assert "drive.rpdo_transmission_type = 1, synchronous" in shown
    assert 'control.feed_forward = "measured"' in messages


@pytest.mark.parametrize("name", ["virtual", "paper"])
def test_every_shipped_virtual_configuration_has_its_margin(name: str) -> None:
    found = require_margin(load_config(shipped_config(name)))
    assert found.phase_margin_deg >= 20.0


def test_too_small_a_margin_is_refused_with_numbers() -> None:
    shown, messages, code = run_check(changed("control", **PAPER_SIMULATION))
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


def test_an_unstable_loop_is_called_so() -> None:
    shown, messages, code = run_check(load_config(shipped_config("paper")), 8e-3)
    assert code == 9
    assert "NO" in shown
    assert "the control loop is unstable" in messages


def test_the_limit_is_met_exactly_at_the_boundary() -> None:
    config = load_config(shipped_config("paper"))
    margin_deg = require_margin(config).phase_margin_deg
    for above_deg, refused in ((-1e-9, False), (0.0, False), (1e-9, True), (0.1, True)):
        wanted = changed("margin", min_phase_margin_deg=margin_deg + above_deg)
        if refused:
            with pytest.raises(MarginError):
                require_margin(wanted)
        else:
            require_margin(wanted)


def test_the_override_accepts_a_small_margin_but_never_an_unstable_loop() -> None:
    config = changed("control", **PAPER_SIMULATION)
    with pytest.raises(MarginError):
        require_margin(config)
    assert require_margin(config, allow_low_margin=True).stable
    shown, _, code = run_check(config, allow_low_margin=True)
    assert code == 0
    assert "below the minimum, accepted" in shown
    with pytest.raises(MarginError, match="unstable"):
        require_margin(config, 8e-3, allow_low_margin=True)


def test_the_measured_delay_decides() -> None:
    config = changed("control", **PAPER_SIMULATION)
    assert require_margin(config, 0.3e-3).phase_margin_deg > 20.0
    with pytest.raises(MarginError, match=r"1\.5 ms loop delay"):
        require_margin(config, 1.5e-3)


def test_json_holds_the_same_numbers() -> None:
    shown, _, code = run_check(changed("control", **PAPER_SIMULATION), json=True)
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


def test_json_of_an_unstable_loop_is_valid() -> None:
    shown, _, _ = run_check(load_config(shipped_config("paper")), 8e-3, json=True)
    data = json.loads(shown)
    assert data["margins"]["stable"] is False
    assert data["margins"]["sensitivity_peak"] is None  # infinite


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
    shown, _, _ = run_check(load_config(shipped_config("paper")), delay_s, figure=path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert "loop.png" in shown


@pytest.mark.parametrize(
    ("transmission_type", "periods"), [(0, 1.0), (1, 1.0), (2, 2.0), (240, 240.0), (254, 1.0), (255, 1.0)]
)
def test_the_assumed_delay_follows_the_rpdo(transmission_type: int, periods: float) -> None:
    config = changed("drive", rpdo_transmission_type=transmission_type)
    settings, assumptions = loop_settings(config)
    assert settings.delay_s == pytest.approx(periods * 1e-3)
    origin = assumptions[1].origin
    assert origin.startswith("assumed: ")
    assert ("asynchronous" in origin) is (transmission_type > 240)


def test_measured_beats_configured_beats_assumed() -> None:
    config = changed("margin", loop_delay_s=1.7e-3, current_lag_s=0.9e-3)
    settings, assumptions = loop_settings(config)
    assert (settings.delay_s, settings.lag_s) == (1.7e-3, 0.9e-3)
    assert assumptions[1].origin == "margin.loop_delay_s"
    settings, assumptions = loop_settings(config, 2.5e-3)
    assert settings.delay_s == 2.5e-3
    assert assumptions[1].origin == "measured"


def test_the_section_of_the_configuration_is_used() -> None:
    config = changed("margin", loop_delay_s=0.0, current_lag_s=0.001)
    settings, _ = loop_settings(config)
    assert (settings.delay_s, settings.lag_s) == (0.0, 0.001)  # a delay of 0 is a value, not "unknown"


def test_a_negative_measured_delay_is_named() -> None:
    with pytest.raises(ConfigurationError, match=r"delay_s \(=-0\.001\) must be >= 0"):
        require_margin(load_config(shipped_config("paper")), -1e-3)


def test_every_kind_of_the_configuration_can_be_checked() -> None:
    assert set(CONTROLLERS) == set(ControllerKind)
    for kind, extra in (
        ("computed_torque", {}),
        ("computed_torque_observer", {"observer_radps": 60.0}),
        ("pid", {"kp": 6075.0, "kv": 135.0, "ki": 91125.0}),
    ):
        shown, _, code = run_check(changed("control", kind=kind, **extra))
        assert code == 0
        assert "eigenvalues of P" not in shown


def test_remedies_of_the_other_kinds_name_their_own_settings() -> None:
    pid = changed("control", kind="pid", kp=6075.0, kv=135.0, ki=91125.0)
    assert ", ki = " in run_check(pid, 5e-3)[1]
    observer = changed("control", kind="computed_torque_observer", observer_radps=200.0)
    assert "control.observer_radps = " in run_check(observer, 3e-3)[1]


def test_widths_and_q_pairs_arrive() -> None:
    widths = tuple(0.01 * (i + 1) for i in range(15))
    settings, _ = loop_settings(changed("control", widths=widths, lyapunov_q=(1000.0, 20.0)))
    assert settings.widths == widths
    assert settings.q == (1000.0, 20.0)
    assert len(settings.centres) == 15
    assert phase_margin_deg(settings) > 0.0


def test_what_the_model_leaves_out_is_said() -> None:
    config = changed("joint", gravity_Nm=5.0, coriolis_Nmspr=0.1)
    config = changed("control", config, dead_zone_rad=1e-4)
    texts = not_modelled(config)
    assert [text.split(" ")[0] for text in texts] == [
        "control.feed_forward", "joint.gravity_Nm", "joint.coriolis_Nmspr", "control.dead_zone_rad",
    ]  # fmt: skip
    assert not_modelled(changed("control", feed_forward="desired")) == []


def precise_with(bits: int, side: str = "joint") -> Config:
    config = load_config(shipped_config("precise"))
    return changed("encoder", config, counts_per_turn=2**bits, side=side)


@pytest.mark.parametrize(
    ("bits", "side", "warned"), [(14, "joint", True), (16, "joint", True), (17, "joint", False), (14, "motor", False)]
)
def test_an_encoder_too_coarse_for_the_gains_is_told(bits: int, side: str, warned: bool) -> None:
    texts = [text for text in not_modelled(precise_with(bits, side)) if "chatter" in text]
    assert bool(texts) is warned


def test_a_soft_reducer_is_told_with_its_resonance() -> None:
    config = load_config(shipped_config("precise"))
    assert not [text for text in not_modelled(config) if "reducer" in text]
    soft = changed(
        "virtual",
        config,
        flexible=True,
        motor_side_inertia_kgm2=1.05,
        reducer_stiffness_Nmprad=1.05 / 2 * 6283.2**2 / 1e4,
    )
    assert [text for text in not_modelled(soft) if "the reducer resonates at 10.0 Hz" in text]


def test_of_a_real_joint_nobody_knows_the_reducer() -> None:
    config = load_config(shipped_config("precise")).model_copy(update={"virtual": None})
    assert [text for text in not_modelled(config) if "flexibility of the reducer" in text]


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
    config = load_config(shipped_config("elmo_serial"))
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for fault-campaign'):
        fault_campaign(config, Output())
    with pytest.raises(ConfigurationError, match=r'drive.kind \(=elmo_serial\) must be "canopen" for study'):
        from_file("elmo_serial")
    require_simulated(load_config(shipped_config("virtual")), "fault-campaign")  # the twin
