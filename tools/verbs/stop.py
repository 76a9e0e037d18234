"""`jointctl stop`: from a second terminal, whatever the first one is doing."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import AS_CONFIGURED, BusOptions, ConfigPath, ResultOutput, config_path, place

if TYPE_CHECKING:
    from jointctl.tools.verbs.bench_drive import StopTarget


def stop(config: ConfigPath, output: ResultOutput, bus: BusOptions = AS_CONFIGURED) -> int:
    """Stop and disable the drive now, or all those of an arm, also while another program controls them."""
    # Nothing but the address is taken from the configuration, which need not hold; what is wrong with it comes after.
    # The drive is stopped at once, and once more when that program has ended: it cannot enable it any more then.
    from jointctl.drivers.bus_lock import StopCall, end_programs, lock_name, marked_processes
    from jointctl.drivers.drive import common_state, is_safe
    from jointctl.drivers.stop_note import LOCKS
    from jointctl.tools.verbs.bench_drive import stop_targets

    path = config_path(config)
    targets, unread = stop_targets(path, place(bus))
    states: list[str] = []
    failures: list[Exception] = []

    def switch_off() -> None:
        failures.clear()
        try:
            states[:] = _switch_off(list(targets.values()), output)
        except Exception as error:  # whatever it is, the program that controls the drive has still to be ended
            failures.append(error)

    with ExitStack() as stack:
        calls = [
            stack.enter_context(StopCall(*on)) for on in dict.fromkeys(target.place for target in targets.values())
        ]
        switch_off()
        from jointctl.tools.session.result import require_off  # takes its time to load: before the last look

        found = end_programs(calls, output.note, switch_off)
    if not found:  # another joint may be the one that was meant
        places = dict.fromkeys(target.place for target in targets.values())
        others = set(marked_processes(LOCKS)).difference(*(marked_processes(lock_name(*place)) for place in places))
        if others:
            buses, pids = ", ".join(":".join(place) for place in places), ", ".join(map(str, sorted(others)))
            output.warning(
                f"found no program to end on {buses}; those that control another bus go on, with the processes {pids}: "
                "`jointctl stop` with the file of that joint"
            )
    if failures:
        raise failures[0]
    state = common_state(list(targets), states)
    which = "the drive is" if len(states) == 1 else f"{'all' if is_safe(state) else 'of'} {len(states)} drives:"
    try:
        output.result(f"{which} {state}", {"drive_state": state}, state)
    finally:  # a result that cannot be written must not hide that the drive is not off
        if not unread:
            _warn_of(path, output)
        require_off(state)
    if unended := next(filter(None, (call.unended for call in calls)), ""):
        raise BusError(f"{unended}; the drive may be enabled again", "end it as its user, or as root")
    if unread:
        raise unread[0]
    return 0


def _switch_off(targets: Sequence[StopTarget], output: Output) -> list[str]:
    """Of all drives at once: none waits for another one that does not answer.  An error when all have been tried."""
    from jointctl.drivers.drive import at_once

    return at_once([partial(target.switch_off, output) for target in targets])


def _warn_of(path: Path, output: Output) -> None:
    from jointctl.tools.configuration.arm import load_joint_or_arm  # the stop itself does not wait for its modules

    try:
        load_joint_or_arm(path)
    except ConfigurationError as error:
        for line in error.message.splitlines():
            output.warning(f"the stop was sent, but the configuration does not hold: {line}")
