"""What a run log says about its run besides the records: configuration, drive, versions, friction model."""

from __future__ import annotations

import hashlib
import json
import platform
from importlib.metadata import PackageNotFoundError, version

from jointctl.drivers.drive import CommissioningReport
from jointctl.tools.configuration.config import Config

_PACKAGES = ("jointctl", "numpy", "numba", "python-can", "canopen", "mcap")


def run_metadata(config: Config, report: CommissioningReport) -> dict[str, dict[str, str]]:
    """Metadata records by name; all values are text."""
    return {
        "run": {"configuration": config.text, "path": str(config.path)},
        "drive": {**vars(report.identity), "mode": report.mode, **report.settings},
        "friction": {"sha256": friction_sha256(config)},
        "versions": versions(),
    }


def friction_sha256(config: Config) -> str:
    """Of the values of [friction] in force, whatever the file looks like; "" without one."""
    if config.friction is None:
        return ""
    values = json.dumps(config.friction.model_dump(), sort_keys=True)
    return hashlib.sha256(values.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Python, system, and the packages that decide what was computed and written."""
    found = {"python": platform.python_version(), "system": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found
