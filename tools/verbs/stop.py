"""`jointctl stop`: from a second terminal, whatever the first one is doing."""

from __future__ import annotations

from pathlib import Path

from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import AS_CONFIGURED, BusOptions, ConfigPath, ResultOutput, config_path, place


def stop(config: ConfigPath, output: ResultOutput, bus: BusOptions = AS_CONFIGURED) -> int:
    """Stop and disable the drive now, also while another program controls it."""
    # Nothing but the address is taken from the configuration, which need not hold; what is wrong with it comes after.
    # The drive is stopped at once, and once more when that program has ended: it cannot enable it any more then.
    from jointctl.tools.session.result import require_off
    from jointctl.tools.session.stop_call import StopCall
    from jointctl.tools.verbs.bench_drive import stop_target

    path = config_path(config)
    target = stop_target(path, place(bus))
    with StopCall(*target.place) as call:
        failure: JointctlError | None = None
        try:
            state = target.switch_off(output)
        except JointctlError as error:
            failure = error
        if call.end(output.note):
            state = target.switch_off(output)
        elif failure is not None:
            raise failure
    try:
        output.result(f"the drive is {state}", {"drive_state": state}, state)
    finally:  # a result that cannot be written must not hide that the drive is not off
        _warn_of(path, output)
        require_off(state)
    return 0


def _warn_of(path: Path, output: Output) -> None:
    from jointctl.tools.configuration.load import load_config  # the stop itself does not wait for its modules

    try:
        load_config(path)
    except ConfigurationError as error:
        for line in error.message.splitlines():
            output.warning(f"the stop was sent, but the configuration does not hold: {line}")
