"""What the user reads of a run: each fault and notice, its events, a pause before its end, and the exit code."""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl import verbs
from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DataError, DeviceError, MotionFault
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram
from jointctl.firmware_py.records import ENCODER_RESTARTED, AxisState, LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveState, Fault, Notice
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, WARNING, Event
from jointctl.tools.recording.run_summary import summarise
from jointctl.tools.session import result as run_report
from jointctl.tools.session import session as session_module
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import OVERRUN_CYCLES, EventFinder, PhaseLines
from jointctl.tools.session.elmo_drive import ElmoSession, serial_fault_text
from jointctl.tools.session.fault_words import (
    FAULT_TEXTS,
    FaultText,
    NoticeFinder,
    emergency_text,
    fault_text,
    held_up_text,
    longest_pause_s,
)
from jointctl.tools.session.result import RunResult
from jointctl.tools.session.run_watch import RunWatch
from jointctl.tools.session.session_drive import latched_text, session_drive
from jointctl.tools.sweeping import carry_out
from jointctl.tools.verbs import scope as scope_module
from jointctl.tools.verbs.doctor import doctor_motion
from tests.configurations import own_loop, shipped
from tests.run_records import START_NS, WORDS, eventful_records, run_records

# --- What the user is told of each fault: what happened with numbers, code and name, likely cause, next step ---
FAULTS = [fault for fault in Fault if fault is not Fault.NONE]
WITH_STATUSWORD = (
    Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.ENABLE_TIMEOUT, Fault.OFF_TIMEOUT, Fault.DRIVE_STAYS_ENABLED,
)  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_a_drive_that_closes_its_own_loop_is_not_blamed_on_gains_that_are_not_used(fault: Fault, mode: str) -> None:
    """LIMIT_CYCLE in CSP sent its reader to kp, kv and observer_radps."""
    config = shipped("virtual") if mode == "cst" else own_loop(mode)
    text = session_drive("canopen").fault_text(config, fault, 1.0, 0)
    ours = re.compile(r"\b(kp|kv|observer_radps|learning|lower the gains|loop delay)\b")
    of_gains = (Fault.LIMIT_CYCLE, Fault.STOP_TIMEOUT, Fault.VELOCITY_LIMIT)
    assert bool(ours.search(text.advice)) is (mode == "cst" and fault in of_gains)
    assert text.happened == fault_text(fault, 1.0, 0).happened


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("value", [0.0, -1.5, 663.0, 1e9, math.nan, math.inf])
def test_every_fault_tells_what_happened_why_and_what_to_do(fault: Fault, value: float) -> None:
    text = fault_text(fault, value, 0)
    for part in (text.happened, text.cause, text.next_step):
        assert part.strip() == part != ""
        assert "{" not in part
        assert "\n" not in part
    assert "error code" not in text.happened
    assert "error code is 2310h, continuous overcurrent" in fault_text(fault, value, 0x2310).happened


@pytest.mark.parametrize("fault", WITH_STATUSWORD)
def test_a_statusword_is_told_as_such_and_with_its_state_and_a_serial_line_has_none(fault: Fault) -> None:
    """It was reported as a decimal number."""
    assert "(statusword 0297h, quick stop active)" in fault_text(fault, float(0x0297), 0).happened
    assert "(statusword 0218h, fault)" in fault_text(fault, float(0x0218), 0).happened
    text = serial_fault_text(fault, 0.0)
    assert text is not None
    assert "(SR {word})" in text.happened


@pytest.mark.parametrize("fault", [Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED])
@pytest.mark.parametrize(
    ("code", "communication"),
    [(0, False), (0x80FF, False), (0x8110, True), (0x8130, True), (0x8250, True), (0x8300, False), (0x7300, False)],
)
def test_a_drive_that_did_not_hear_us_does_not_send_the_user_to_its_sto_wiring(
    fault: Fault, code: int, communication: bool
) -> None:
    text = fault_text(fault, float(0x0297), code)
    assert ("heard our frames too seldom" in text.cause) is communication
    assert (text.cause == FAULT_TEXTS[fault].cause) is not communication
    assert fault_text(Fault.STALE_SAMPLE, 51.0, code).cause == FAULT_TEXTS[Fault.STALE_SAMPLE].cause


@pytest.mark.parametrize("fault", FAULTS)
def test_an_error_is_told_as_that_of_the_node_that_has_it(fault: Fault) -> None:
    """The encoder's EMCY was reported as the drive's."""
    told = fault_text(fault, 6.0, 0, 0x5000, two_encoders=True).happened
    assert "the encoder node's error code is 5000h" in told
    assert "drive's error code" not in told
    assert "encoder node restarted" in fault_text(fault, 6.0, 0, ENCODER_RESTARTED, two_encoders=True).happened
    told = fault_text(fault, 6.0, 0x5000, two_encoders=True).happened
    assert "the drive's error code is 5000h" in told
    assert "encoder node" not in told


@pytest.mark.parametrize("fault", FAULTS)
def test_a_missing_sample_of_two_encoders_may_be_that_of_either(fault: Fault) -> None:
    two, one = fault_text(fault, 6.0, 0, two_encoders=True), fault_text(fault, 6.0, 0)
    assert (
        (two != one)
        is (FAULT_TEXTS[fault].two_encoders is not None)
        is (fault in (Fault.STALE_SAMPLE, Fault.NO_SAMPLES))
    )
    if two != one:
        assert "encoder" in two.happened
        assert "the joint's encoder" in two.cause
        assert "not believed" in fault_text(fault, 6.0, 0, 0x5000, two_encoders=True).cause


@pytest.mark.parametrize(("code", "words"), [(0, ""), (0x7300, "; the drive's error code is 7300h, feedback sensor")])
def test_what_a_loop_has_latched_is_told_with_the_errors_of_drive_and_encoder(code: int, words: str) -> None:
    """In simulated time they were left out."""
    state = new(AxisState)[0]
    assert latched_text(CONFIG, state) is None
    state.fault, state.fault_value, state.fault_drive_error = Fault.STALE_SAMPLE, 6.0, code
    text = latched_text(CONFIG, state)
    assert text is not None
    assert text.happened == f"no position came for 6 cycles, at once or again and again{words}"
    state.fault_encoder_error = 0x5000
    text = latched_text(load_config(shipped_config("realistic")), state)
    assert text is not None
    assert "both encoders" in text.happened
    assert "the encoder node's error code is 5000h" in text.happened


@pytest.mark.parametrize(("status", "words"), [(0x8110, "stayed away"), (0x8100, "switched off without being asked")])
def test_a_status_with_the_servo_on_does_not_pass_for_a_motor_that_was_switched_off(status: int, words: str) -> None:
    text = serial_fault_text(Fault.DRIVE_NOT_ENABLED, float(status))
    assert text is not None
    assert words in text.happened


@pytest.mark.parametrize(
    ("status", "motor_fault", "words"),
    [
        (0x87, 0, "; the drive says safe torque off (STO)"),
        (0xC0, 0, ""),
        (0x87, 0x20000, "; the drive says MF 20000h ("),
    ],
)
def test_a_serial_fault_without_a_motor_fault_names_what_the_amplifier_reports(
    status: int, motor_fault: int, words: str
) -> None:
    """Its hint was to see the drive's motor fault, which is none where STO was opened."""
    text = ElmoSession().fault_text(CONFIG, Fault.DRIVE_FAULT, float(status), motor_fault)
    assert text.happened.partition("h)")[2].startswith(words)
    assert bool(text.happened.partition("h)")[2]) is bool(words)


# --- What the loop reports without ending the run: each once, with its numbers and what to do about it ---
def state_with(notices: int) -> Any:
    state = new(AxisState)[0]
    state.notices, state.swing.noise_told_Nm, state.law.learning.error_rad = notices, 12.04, 3.21e-5
    state.measured_position_rad, state.stood_rad = 0.487, 0.5
    state.swing.rest_error.amplitude, state.swing.rest_error.half_cycles = 2.6e-3, 106
    return state


@pytest.mark.parametrize(
    ("notice", "words"),
    [
        (Notice.TORQUE_NOISE, ("12.0 Nm", "encoder", "velocity_cutoff_Hz", "observer_radps")),
        (Notice.LEARNING_OFF, ("0.032 mrad", "control.learning.gain", "loop delay", "off")),
        (Notice.HUNTS, ("2.60 mrad", "in 106 cycles", "control.kv", "observer_radps")),
        (Notice.SANK, ("-0.0130 rad", "torque was released", "nothing but a brake holds it", "support it")),
    ],
)
def test_each_notice_is_told_once_in_a_run(notice: Notice, words: tuple[str, ...]) -> None:
    finder = NoticeFinder()
    assert finder.take(state_with(0), 5) == []
    (event,) = finder.take(state_with(notice), 7)
    assert (event.time_ns, event.level, event.source) == (7, WARNING, "loop")
    assert all(word in event.text for word in words)
    assert finder.take(state_with(notice), 8) == []
    every = sum(Notice)
    assert len(finder.take(state_with(every), 9)) == len(Notice) - 1  # the other ones
    assert finder.take(state_with(every), 10) == []
    assert len(NoticeFinder().take(state_with(every), 0)) == len(Notice)


def test_a_run_tells_them_to_log_display_and_viewers_before_the_fault() -> None:
    """They may explain it."""
    told: list[Any] = []
    noted: list[str] = []
    fault = SimpleNamespace(text="LIMIT_CYCLE", time_ns=1, level=ERROR)
    watch: Any = RunWatch.__new__(RunWatch)

    class Records(list[Any]):
        pass

    records: Any = Records([SimpleNamespace(time_ns=41)])
    block = SimpleNamespace(
        state=[state_with(Notice.LEARNING_OFF)], words=[0] * 64, histograms=None,
        constants=[SimpleNamespace(trajectory=SimpleNamespace(duration_s=1.0))],
    )  # fmt: skip
    watch.loop = SimpleNamespace(block=block, new_records=lambda: records)
    watch.around = SimpleNamespace(recorder=None, signals=StopSignals())
    watch._keep, watch._decimated = lambda _: None, SimpleNamespace(take=lambda new: new)
    watch._orders = SimpleNamespace(keep=lambda _: None)
    watch._notices, watch._events = NoticeFinder(), SimpleNamespace(take=lambda _: [fault])
    watch._tell = lambda event, shown=True: told.append(event)
    watch.config, watch.temperature = (
        shipped("virtual"),
        SimpleNamespace(newest_degC=None),
    )
    watch.display = SimpleNamespace(show=lambda _: None, note=noted.append)
    watch.take_records()
    assert [event.text.split()[0] for event in told] == ["iterative", "LIMIT_CYCLE"]
    assert told[0].time_ns == 41
    assert noted == [told[0].text]


def test_the_advice_of_a_limit_cycle_names_delay_gains_learning_and_resolution() -> None:
    text = fault_text(Fault.LIMIT_CYCLE, 13.94, 0)
    assert "13.9 Hz" in text.happened
    for word in ("loop delay", "gains", "learning", "resolution"):
        assert word in FAULT_TEXTS[Fault.LIMIT_CYCLE].advice


# --- A pause of the loop just before a fault is told with it, and only then ---
RATE_Hz = 125.0
TEXT = FaultText("it happened", "the cable", "check it")
FAULTY = 180


def paused_records(fault: Fault = Fault.STALE_SAMPLE, **at: tuple[int, int]) -> np.recarray[Any, Any]:
    """200 cycles of 8 ms, the fault in the 181st and after; `at`: field = (index, value)."""
    records = new(LogRecord, 200)
    records.time_ns = 10**15 + np.arange(200) * 8_000_000
    records.fault[FAULTY:] = fault
    records.round_trip_ns = 1_200_000
    for field, (index, value) in at.items():
        records[field][index] = value
    return records


def told(fault: Fault, value: float, records: Any) -> bool:
    text = held_up_text(fault, value, TEXT, records, RATE_Hz)
    assert ("held up" in text.happened) == (text != TEXT)
    return text != TEXT


@pytest.mark.parametrize(
    ("fault", "value", "field", "index", "paused", "expected"),
    [
        *((Fault.STALE_SAMPLE, 20.0, "skipped", FAULTY, cycles, cycles >= 10) for cycles in (19, 10, 9)),
        *((Fault.VELOCITY_LIMIT, 1.9, field, 178, pause_ns, pause_ns > 24_000_000)
          for field in ("round_trip_ns", "wake_late_ns", "work_ns") for pause_ns in (24_100_000, 23_900_000)),
        # only one just before counts
        *((Fault.VELOCITY_LIMIT, 1.9, "skipped", index, 40, index in (118, FAULTY))
          for index in (117, 118, FAULTY, FAULTY + 1)),
        (Fault.LIMIT_CYCLE, 9.0, "skipped", FAULTY, 4, True),  # not to be laid to the gains alone
        (Fault.POSITION_DISAGREEMENT, 0.1, "skipped", FAULTY, 90, False),  # no pause causes it
    ],
)  # fmt: skip
def test_a_pause_that_may_have_caused_it_is_reported(
    fault: Fault, value: float, field: str, index: int, paused: int, expected: bool
) -> None:
    assert told(fault, value, paused_records(fault, **{field: (index, paused)})) is expected


def test_at_a_high_rate_three_cycles_are_no_pause() -> None:
    records = paused_records(Fault.VELOCITY_LIMIT, skipped=(FAULTY, 4))
    assert held_up_text(Fault.VELOCITY_LIMIT, 1.9, TEXT, records, 1000.0) == TEXT
    records = paused_records(Fault.VELOCITY_LIMIT, skipped=(FAULTY, 5))
    assert "for 5 ms" in held_up_text(Fault.VELOCITY_LIMIT, 1.9, TEXT, records, 1000.0).happened


def test_the_text_keeps_the_other_cause_and_what_to_do() -> None:
    text = held_up_text(Fault.STALE_SAMPLE, 20.0, TEXT, paused_records(skipped=(FAULTY, 19)), RATE_Hz)
    assert text.happened == "it happened, after the loop had been held up for 152 ms"
    assert text.cause.endswith("if that pause was not the cause, the cable")
    assert text.next_step == "run `jointctl doctor`; check it"
    assert longest_pause_s(paused_records(Fault.NONE, skipped=(FAULTY, 90)), 0.008) == 0.0


# --- Events: what happened in a run, found in its records; error codes in words ---
@pytest.mark.parametrize("size", [1, 7, 20, 400])
def test_events_are_the_same_whatever_the_pieces(size: int) -> None:
    finder, records = EventFinder(session_drive("canopen")), eventful_records()
    found = [event for at in range(0, 400, size) for event in finder.take(records[at : at + size])]
    assert [(event.time_ns - START_NS, event.source, event.text) for event in found] == [
        (0, "drive", "switch on disabled (statusword 0250h)"),
        (0, "loop", "waiting"),
        (20_000_000, "drive", "switched on (statusword 0233h)"),
        (20_000_000, "loop", "enabling"),
        (30_000_000, "drive", "operation enabled (statusword 1237h)"),
        (30_000_000, "loop", "tracking"),
        (350_000_000, "drive", "switch on disabled (statusword 0250h)"),
        (350_000_000, "loop", "finished"),
    ]


def test_a_bit_that_changes_no_state_is_no_event() -> None:
    records = eventful_records()
    records.status_word[100:200] ^= 0x0400  # target reached
    assert len(EventFinder(session_drive("canopen")).take(records)) == 8


def test_a_fault_is_told_with_code_cause_and_state() -> None:
    records = eventful_records()
    records.fault[200:] = Fault.DRIVE_FAULT
    records.drive_error[200:] = 0x8130
    records.drive_state[200:] = DriveState.FAULT
    records.status_word[200:] = WORDS[DriveState.FAULT]
    finder = EventFinder(session_drive("canopen"), fault_words=lambda fault, error: f"{fault.name} and {error:x}")
    texts = [(event.level, event.text) for event in finder.take(records) if event.time_ns == START_NS + 200_000_000]
    assert texts == [
        (40, "EMCY 8130h, heartbeat lost"),
        (30, "fault (statusword 0218h)"),
        (40, "DRIVE_FAULT (8): DRIVE_FAULT and 8130"),
    ]


@pytest.mark.parametrize(("skipped", "told"), [(0, 0), (OVERRUN_CYCLES - 1, 0), (OVERRUN_CYCLES, 1), (500, 1)])
def test_a_long_overrun_is_an_event(skipped: int, told: int) -> None:
    records = eventful_records()
    records.skipped[100] = skipped
    assert sum("skipped" in event.text for event in EventFinder(session_drive("canopen")).take(records)) == told


@pytest.mark.parametrize(
    ("code", "name"),
    [(0x8130, "heartbeat lost"), (0x8199, "communication"), (0x2FFF, "current"), (0xFF77, "maker"), (0x00FF, "not in")],
)
def test_an_unknown_emergency_code_is_told_by_its_class(code: int, name: str) -> None:
    assert name in emergency_text(code)
    assert f"{code:04X}h" in emergency_text(code)


# --- The end of a run: what is told first, and the exit code ---
CONFIG = load_config(shipped_config("virtual"))
WITHOUT_PICTURE = CONFIG.changed(log__picture=False)

REPORT = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)


def result(folder: Path, fault: Fault) -> RunResult:
    records = run_records()
    histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
    return RunResult(
        summary=summarise(records, histograms), records=records, histograms=histograms, fault=fault,
        fault_text=fault_text(fault, 5.0, 0) if fault is not Fault.NONE else None, stopped_by="", drive_state="off",
        bus_load=0.3, load_row=("line load", "30%"), lost_records=0, log_path=folder / "run.mcap", report=REPORT,
    )  # fmt: skip


def test_a_picture_is_called_by_what_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    titles: list[str] = []
    monkeypatch.setattr(run_report, "save_run_figure", lambda records, path, title: titles.append(title) or path)
    for motion in ("", "hold"):
        run_report.report_run(result(tmp_path, Fault.NONE), Output(stdout=io.StringIO()), CONFIG, motion)
    assert titles == [f"{CONFIG.path.stem}: {CONFIG.trajectory.kind}", f"{CONFIG.path.stem}: hold"]


@pytest.mark.parametrize(("joints", "words"), [(1, "the joint is off"), (2, "the joints are off")])
def test_what_was_stopped_is_off(tmp_path: Path, joints: int, words: str) -> None:
    one = replace(result(tmp_path, Fault.NONE), stopped_by="SIGINT")
    found, err = replace(one, others=(one,) * (joints - 1)), io.StringIO()
    assert run_report.report_run(found, Output(stdout=io.StringIO(), stderr=err), WITHOUT_PICTURE) == 130
    assert err.getvalue() == f"stopped by SIGINT; {words}\n"


def test_of_several_faults_the_first_one_is_the_cause(tmp_path: Path) -> None:
    """A drive that is lost costs the others their heartbeat, and they have faults of their own after it."""
    after = replace(result(tmp_path, Fault.OFF_TIMEOUT), name="shoulder", fault_slot_ns=2)
    cause = replace(result(tmp_path, Fault.DRIVE_RESTARTED), name="elbow", fault_slot_ns=1)
    sound = replace(result(tmp_path, Fault.NONE), name="wrist")
    found, err = replace(after, others=(cause, sound)), io.StringIO()
    assert run_report.report_run(found, Output(stdout=io.StringIO(), stderr=err), WITHOUT_PICTURE) == 7
    told = [line.split(" ")[1:3] for line in err.getvalue().splitlines() if line.startswith("error: ")]
    assert told == [["elbow:", "DRIVE_RESTARTED"], ["shoulder:", "OFF_TIMEOUT"]]
    for joints in (found, replace(sound, others=(cause,))):
        with pytest.raises(MotionFault, match=r"^elbow: DRIVE_RESTARTED"):
            verbs._raise("run", 7, joints)


@pytest.mark.parametrize(("fault", "code"), [(Fault.BUS_ERROR, 7), (Fault.NONE, 0)])
def test_the_cause_is_told_before_the_picture_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Fault, code: int
) -> None:
    out, err = io.StringIO(), io.StringIO()
    told: list[str] = []
    shown: list[str] = []

    def draw(records: Any, path: Path, title: str) -> Path:
        told.append(err.getvalue())
        shown.append(out.getvalue())
        return path

    monkeypatch.setattr(run_report, "save_run_figure", draw)
    assert run_report.report_run(result(tmp_path, fault), Output(stdout=out, stderr=err), CONFIG) == code
    assert err.getvalue() == told[0]  # nothing more comes after it
    assert told[0].startswith("error: BUS_ERROR") == (fault is Fault.BUS_ERROR)
    assert ("hint: likely cause" in told[0]) == (fault is Fault.BUS_ERROR)
    assert "run.mcap" in shown[0]  # the result is there before the picture is drawn
    assert out.getvalue() == f"{shown[0]}picture    {tmp_path / 'run.png'}\n"


def test_a_program_gets_one_document_when_the_picture_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(run_report, "save_run_figure", lambda records, path, title: path if not out.getvalue() else 0)
    run_report.report_run(result(tmp_path, Fault.NONE), Output(json=True, stdout=out), CONFIG)
    assert json.loads(out.getvalue())["picture"] == str(tmp_path / "run.png")


@pytest.mark.parametrize("fault", [Fault.NONE, Fault.BUS_ERROR])
def test_a_picture_that_cannot_be_written_does_not_hide_the_result(tmp_path: Path, fault: Fault) -> None:
    (tmp_path / "run.png").mkdir()
    out, err = io.StringIO(), io.StringIO()
    code = run_report.report_run(result(tmp_path, fault), Output(stdout=out, stderr=err), CONFIG)
    assert code == (0 if fault is Fault.NONE else 7)
    assert "run.png: cannot be written: Is a directory" in err.getvalue().replace("\n", " ")
    assert "run.mcap" in out.getvalue()
    assert "picture " not in out.getvalue()


def test_a_log_that_is_lost_has_an_exit_code_and_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_report, "save_run_figure", lambda *_: pytest.fail("it would be beside the log"))
    for fault, code in ((Fault.NONE, 8), (Fault.BUS_ERROR, 7)):
        out = io.StringIO()
        found = replace(result(tmp_path, fault), log_lost=True)
        assert run_report.report_run(found, Output(json=True, stdout=out, stderr=io.StringIO()), CONFIG) == code
        assert json.loads(out.getvalue())["log"] is None


@pytest.mark.parametrize("lost", [True, False])
def test_no_verb_names_a_log_that_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: bool) -> None:
    found, out, err = replace(result(tmp_path, Fault.NONE), log_lost=lost), io.StringIO(), io.StringIO()
    for module in (session_module, carry_out):
        monkeypatch.setattr(module, "Session", lambda *_: SimpleNamespace(run=lambda: found, drive_state="off"))
    config = CONFIG.changed(log__folder=tmp_path)
    output = Output(stdout=out, stderr=err)
    doctor_motion(config, output, assume_yes=True)
    assert (f"log: {tmp_path / 'run.mcap'}" in err.getvalue()) is not lost
    plan: Any = SimpleNamespace(config=config)
    with pytest.raises(DataError, match="lost; no map") if lost else contextlib.nullcontext():
        assert carry_out.carried_out(plan, output, "map", assume_yes=True, dry_run=False) is found
    feed: Any = SimpleNamespace(settings=lambda *_: None, forget=lambda: None, stop_request=lambda: None)
    runs = scope_module._Runs(config, output, feed, "title", allow_low_margin=False)
    runs.one()
    assert runs.last_end["stage"] == "ended"
    assert f"log      {'lost' if lost else tmp_path / 'run.mcap'}" in runs.last_end["lines"]


@pytest.mark.parametrize(("by", "fault"), [("", Fault.BUS_ERROR), ("SIGINT", Fault.NONE)])
@pytest.mark.parametrize("lost", [True, False])
def test_a_motion_that_measures_names_its_log_where_it_was_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str, fault: Fault, lost: bool
) -> None:
    found, err = replace(result(tmp_path, fault), stopped_by=by, log_lost=lost), io.StringIO()
    monkeypatch.setattr(carry_out, "Session", lambda *_: SimpleNamespace(run=lambda: found, drive_state="off"))
    plan: Any = SimpleNamespace(config=CONFIG.changed(log__folder=tmp_path))
    with contextlib.nullcontext() if by else pytest.raises(MotionFault, match="no map"):
        assert carry_out.carried_out(plan, Output(stderr=err), "map", assume_yes=True, dry_run=False) == 130
    assert (f"log: {tmp_path / 'run.mcap'}" in err.getvalue()) is not lost


def reported_to_a_full_disk(found: RunResult) -> int:
    with Path("/dev/full").open("w") as full:
        return run_report.report_run(found, Output(stdout=full, stderr=io.StringIO()), WITHOUT_PICTURE)


def test_a_fault_or_a_drive_that_is_not_off_outweighs_a_result_that_cannot_be_written(tmp_path: Path) -> None:
    assert reported_to_a_full_disk(result(tmp_path, Fault.BUS_ERROR)) == 7
    with pytest.raises(DeviceError, match="did not confirm"):
        reported_to_a_full_disk(replace(result(tmp_path, Fault.NONE), drive_state="operation enabled"))
    with pytest.raises(DataError, match="standard output"):
        reported_to_a_full_disk(result(tmp_path, Fault.NONE))


def test_without_a_picture_none_is_drawn_or_told(tmp_path: Path) -> None:
    out = io.StringIO()
    assert run_report.report_run(result(tmp_path, Fault.NONE), Output(stdout=out), WITHOUT_PICTURE) == 0
    assert ".png" not in out.getvalue()
    assert list(tmp_path.iterdir()) == []
    out = io.StringIO()
    run_report.report_run(result(tmp_path, Fault.NONE), Output(json=True, stdout=out), WITHOUT_PICTURE)
    assert json.loads(out.getvalue())["picture"] is None


@pytest.mark.parametrize(("level", "told"), [(ERROR, True), (WARNING, False)])
def test_a_fault_is_told_when_it_happens(level: int, told: bool) -> None:
    err = io.StringIO()
    lines: Any = PhaseLines(Output(stderr=err))
    lines.event(Event(0, level, "loop", "BUS_ERROR (13): the serial port is gone"))
    assert ("BUS_ERROR (13)" in err.getvalue()) == told
