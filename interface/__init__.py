"""jointctl: the controller of a robot joint, on a PC.

    import jointctl

    with jointctl.Joint("my_joint.toml") as joint:
        joint.enable()
        joint.move_to(0.35, duration_s=2.0)

What `__all__` names stays from version to version.  The folders of the repository are the subpackages
(`jointctl.firmware_py`, `jointctl.drivers`, `jointctl.hil`, `jointctl.tools`, `jointctl.configs`); their names may
change.
"""

from __future__ import annotations

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointctl.arm import Arm, ArmState
    from jointctl.drivers.errors import (
        BusError,
        ConfigurationError,
        DataError,
        DeviceError,
        JointctlError,
        MarginError,
        MotionFault,
        NoDeviceError,
        UsageError,
    )
    from jointctl.joint import Joint, SetPointError, State
    from jointctl.signatures import (
        check,
        clear_fault,
        demo,
        doctor,
        excite,
        fault_campaign,
        info,
        map,
        new,
        paper,
        report,
        response,
        run,
        scan,
        stop,
        study,
        sweep,
        tune,
        validate,
        zero,
    )
    from jointctl.verbs import identify, identify_motion, read_log

    __version__: str

__all__ = [
    "Arm",
    "ArmState",
    "BusError",
    "ConfigurationError",
    "DataError",
    "DeviceError",
    "Joint",
    "JointctlError",
    "MarginError",
    "MotionFault",
    "NoDeviceError",
    "SetPointError",
    "State",
    "UsageError",
    "__version__",
    "check",
    "clear_fault",
    "demo",
    "doctor",
    "excite",
    "fault_campaign",
    "identify",
    "identify_motion",
    "info",
    "map",
    "new",
    "paper",
    "read_log",
    "report",
    "response",
    "run",
    "scan",
    "stop",
    "study",
    "sweep",
    "tune",
    "validate",
    "zero",
]

_HOMES = {"Joint": "joint", "SetPointError": "joint", "State": "joint", "Arm": "arm", "ArmState": "arm"}


def __getattr__(name: str) -> object:
    """A name of `__all__`, whose module is loaded only when someone asks for it."""
    if name == "__version__":
        from importlib.metadata import version

        return version("jointctl")
    if name not in __all__:
        raise AttributeError(f"module 'jointctl' has no attribute {name!r}")
    home = _HOMES.get(name) or ("verbs" if name.islower() else "drivers.errors")
    return getattr(_import_module(f"jointctl.{home}"), name)
