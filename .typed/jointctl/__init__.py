"""jointctl: the controller of a robot joint, on a PC.

Everything that is installed lies under this one name; the folders of the repository are its subpackages
(`jointctl.firmware_py`, `jointctl.drivers`, `jointctl.hil`, `jointctl.tools`, `jointctl.configs`).
"""

from __future__ import annotations

from importlib.metadata import version as _version


def __getattr__(name: str) -> str:
    """`__version__`, which is looked up only when someone asks: that takes a while."""
    if name == "__version__":
        return _version("jointctl")
    raise AttributeError(f"module 'jointctl' has no attribute {name!r}")
