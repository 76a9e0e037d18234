"""What every drive offers, whatever its make: slow work in Python, and memory for the compiled cyclic exchange."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from jointctl.drivers.errors import DeviceError, blamed
from jointctl.firmware_py.kernel import kernel

T = TypeVar("T")

UNTOUCHED = "untouched"  # of `Drive.make_safe`: this program has not taken the drive over
Approval = Callable[[str], bool]  # of a question, by the user
SAFE_STATES = ("switch on disabled", "fault", "off")
# of a cyclic exchange: an answer that is looked at so long after its window's end still counts; a wait may end late
LOOK_LATE_NS = 200_000


def is_safe(state: str) -> bool:
    """Whether the drive's words for its state mean that its power stage is off ("fault reaction active" does not)."""
    return state.partition(",")[0] in SAFE_STATES


class Declined(Exception):
    """The user does not want the drive to be touched."""


@dataclass(frozen=True)
class DriveIdentity:
    """Who answered; empty strings where the drive does not report it."""

    vendor: str
    product: str
    revision: str
    serial: str
    name: str = ""

    @property
    def text(self) -> str:
        """What distinguishes one drive from another: vendor, product and serial number."""
        return f"{self.vendor} {self.product} serial {self.serial}"


@dataclass(frozen=True)
class CommissioningReport:
    """What commissioning found and set, for the user and for the run log."""

    identity: DriveIdentity
    mode: str
    start_position_rad: float
    torque_resolution_Nm: float  # at the joint
    position_resolution_rad: float
    settings: dict[str, str] = field(default_factory=dict)  # name -> value read back
    remarks: tuple[str, ...] = ()
    loop_delay_s: float | None = None  # measured, position sample to torque command; None = not measured
    counts_per_motor_turn: float = 0.0  # of the encoder, by the drive's own word; 0 = it does not report it
    commands_velocity: bool = False  # the loop sends it a velocity, and the drive closes that loop
    measures_torque: bool = True  # False: the drive does not report its torque in the cyclic exchange, it reads as zero


@dataclass(frozen=True)
class Reading:
    """What has come of one request: `temperature_degC` is None where nothing has, and `problem` says why."""

    time_ns: int  # CLOCK_MONOTONIC, when the answer came
    temperature_degC: float | None
    problem: str = ""


class Thermometer(Protocol):
    """Reads a temperature now and then, at its own pace."""

    def poll(self) -> Reading | None:
        """What is new, or None.  Never waits and never raises for what the drive or its line does."""


class SettingsGuard(Protocol):
    """Sees that what stops the drive when this computer dies stays as commissioning has set it."""

    @property
    def confirmed(self) -> bool:
        """Whether all of it was read back since `start_cyclic`: nothing may be enabled before."""

    def poll(self, *, may_ask: bool = True) -> list[str]:
        """What is to be warned of; never waits.  `DeviceError` or `BusError` where something was changed, or another
        controller has sent what matters: the run is over.  Without `may_ask` nothing is sent.
        """

    def mode_left(self) -> str:
        """In words that the drive is in another mode than it was set to; asks it, and waits, once it is off.

        "" where it is in its mode, or does not answer.
        """


class Drive(Protocol):
    """A drive on the way from unknown to commissioned, and back to safe."""

    def commission(self, approve: Approval | None = None) -> CommissioningReport:
        """Identify the drive, write and read back limits, arm its watchdog; leaves it disabled.

        A drive that is found enabled is braked only if `approve` agrees to the question that it gets; None: never.
        Raises `NoDeviceError` if no one answers, `DeviceError` if it refuses, differs from the configuration or must be
        left alone, `BusError` where another controller is active, `Declined`.
        """

    def start_cyclic(self) -> None:
        """Let the drive take part in the cyclic exchange; still disabled."""

    def port(self) -> Any:
        """The record array for the cyclic exchange, without a file descriptor; valid after `commission`."""

    def thermometer(self) -> Thermometer | None:
        """What reads the drive's temperature beside the cyclic exchange; None where nothing can.

        Valid from `start_cyclic` until `make_safe`.
        """

    def settings_guard(self) -> SettingsGuard | None:
        """None where nothing can be read beside the loop: it was read back before.  Valid as `thermometer` is."""

    def make_safe(self, *, asked: bool = False) -> str:
        """Disable the drive whatever its state and confirm it; returns the state in words.  Never raises.

        A drive that another controller has taken before the loop began is left alone, unless `asked`: by the user,
        with `jointctl stop`.
        """

    def clear_fault(self) -> str:
        """Reset the drive's own fault; it stays disabled.  Returns what was done, in words.

        Raises `DeviceError` if the fault comes back, `BusError` while another controller is active.
        """

    def close(self) -> None:
        """Release the bus."""


# --- The drives that one loop commands ---


def at_once(calls: Sequence[Callable[[], T]]) -> list[T]:
    """What they return, carried out at the same time; one after the other where no thread can be started.

    The first error among them is raised when all have ended.  An executor would take nothing at all once the main
    thread has ended, which a program's own thread may survive.
    """
    results: dict[int, T] = {}
    errors: dict[int, Exception] = {}

    def carry_out(number: int) -> None:
        try:
            results[number] = calls[number]()
        except Exception as error:
            errors[number] = error

    here, threads = [0], []
    for number in range(1, len(calls)):
        thread = threading.Thread(target=carry_out, args=(number,))
        try:
            thread.start()
            threads.append(thread)
        except RuntimeError:
            here.append(number)
    for number in here:
        carry_out(number)
    for thread in threads:
        thread.join()
    if errors:
        raise errors[min(errors)]
    return [results[number] for number in range(len(calls))]


@runtime_checkable
class DriveOfArm(Protocol):
    """What a drive offers besides where it is one of several: its two long steps in two parts each."""

    def take_over(self, approve: Approval | None = None) -> None:
        """The first part of `commission`: it is found, and off.  Raises as that does."""

    def verify(self) -> None:
        """The first part of `start_cyclic`: everything is read back once more, and nothing is begun."""


class DriveGroup:
    """All drives of a joint or an arm, in the order of its axes; of a joint there is one, and nothing else happens.

    Of an arm, none is commissioned before all are found and off: the proof of one watchdog stops every drive that an
    earlier run has left enabled.  None takes part in the cyclic exchange before all were verified.
    """

    def __init__(self, drives: Sequence[Drive], buses: Sequence[int] = (), names: Sequence[str] = ()) -> None:
        """`buses`: of each drive the number of the first one on the same bus; none: all are on one.

        `names`: of each drive what stands before its errors, see `blamed`, as the file of its joint.
        """
        self.drives, self._buses = tuple(drives), buses
        self._named = list(zip(drives, names or [""] * len(drives), strict=True))
        self._parts = [(d, name) for d, name in self._named if isinstance(d, DriveOfArm)] if len(drives) > 1 else []

    def commission(self, approve: Approval | None = None) -> list[CommissioningReport]:
        """`Drive.commission` of each; all are left disabled."""
        for part, name in self._parts:
            with blamed(name):
                part.take_over(approve)
        reports = []
        for drive, name in self._named:
            with blamed(name):
                reports.append(drive.commission(approve))
        return reports

    def start_cyclic(self) -> None:
        """`Drive.start_cyclic` of each."""
        for part, name in self._parts:
            with blamed(name):
                part.verify()
        for drive, name in self._named:
            with blamed(name):
                drive.start_cyclic()

    def port(self) -> Any:
        """The record arrays of all as one."""
        ports = np.concatenate([drive.port() for drive in self.drives]).view(np.recarray)
        if len(set(self._buses)) > 1:
            ports.bus[:] = self._buses
        return ports

    def make_safe(self, *, asked: bool = False) -> list[str]:
        """`Drive.make_safe` of each, at the same time: none keeps its power while another one does not answer."""
        return at_once([partial(drive.make_safe, asked=asked) for drive in self.drives])

    def close(self) -> None:
        """Release the bus."""
        for drive in self.drives:
            drive.close()


def common_state(names: Sequence[str], states: Sequence[str]) -> str:
    """How the drives of an arm are, as one state in words: `is_safe` if all are, else what is not and whose it is."""
    if len(set(states)) == 1:
        return states[0]
    off = [state for state in states if is_safe(state)]
    differing = [
        f"{name}: {state}" for name, state in zip(names, states, strict=True)
        if state != (off or [""])[0] and (state == UNTOUCHED or is_safe(state))
    ]  # fmt: skip
    powered = [
        f"{name}: {state}" for name, state in zip(names, states, strict=True)
        if state != UNTOUCHED and not is_safe(state)
    ]  # fmt: skip
    return "; ".join(powered) if powered else ", ".join([off[0], *differing])


# --- Whole numbers as every drive is sent them ---


@kernel
def saturated(value: float, limit: float) -> int:
    """`value` rounded, within +-`limit` before the cast; 0 if not finite."""
    if not math.isfinite(value):
        return 0
    return round(min(max(value, -limit), limit))


# --- Position counters of 32 bits that run over, as every drive reports them ---

WRAP = 1 << 32
HALF_WRAP = 1 << 31


class PositionCounter(Protocol):
    """What any driver's record has of it."""

    primed: int
    last_counts: int  # as received
    counts: int  # unwrapped


@kernel
def take_counts(port: PositionCounter, counts: int) -> None:
    """Unwrap the 32 bit position: the joint moves less than half the range between two samples."""
    if port.primed == 0:
        port.primed = 1
        port.counts = counts
    else:
        step = counts - port.last_counts
        if step >= HALF_WRAP:
            step -= WRAP
        elif step < -HALF_WRAP:
            step += WRAP
        port.counts += step
    port.last_counts = counts


# --- A drive that is under power before anything was sent to it: may it be braked? ---
#
# A silent line does not prove that no one controls it: a drive may hold a position, or follow a profile, by itself.  So
# one that turns is left alone; one at rest is braked only when the user has agreed.

WATCH_S = 0.5
WATCH_EACH_S = 0.05
REST_COUNTS, REST_rad = 2, 1e-4  # an enabled joint at rest may move by so much, whichever is more
STOP_HINT = "`jointctl stop` brakes it and switches it off"


def refuse_unless_at_rest(
    place: str, read_counts: Callable[[], int], rad_per_count: float, approve: Approval | None, question: str,
    pause: Callable[[float], None], refuse_others: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Returns when the joint is at rest and `approve` has agreed to the question.

    `place` names the drive and its state; `approve` None: it must not be touched.  Raises `DeviceError` for a drive
    that turns or is not to be touched, `Declined` for a no, and what `refuse_others` raises.
    """

    def watch() -> None:
        readings = [read_counts()]
        for _ in range(round(WATCH_S / WATCH_EACH_S)):
            pause(WATCH_EACH_S)
            readings.append(read_counts())
        refuse_others()
        turned = max(readings) - min(readings)
        if turned > max(REST_COUNTS, REST_rad / abs(rad_per_count)):
            text = f"{place} and turns ({turned} counts in {WATCH_S:g} s): {left_alone}"
            raise DeviceError(text, STOP_HINT)

    left_alone = "another controller may have it, and it was left as it is"
    watch()
    if approve is None:
        raise DeviceError(f"{place}: {left_alone}", STOP_HINT)
    if not approve(question):
        raise Declined
    watch()  # the answer may have taken minutes
