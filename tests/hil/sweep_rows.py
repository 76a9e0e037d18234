"""Rows of a sweep file, and the curve that they should show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jointctl.firmware_py.friction import friction_curve_Nm
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import friction_constants


def rows(out: Path) -> Any:
    return np.genfromtxt(out, delimiter=",", names=True)


def truth_Nm(config: Config, velocity_radps: np.ndarray) -> np.ndarray:
    assert config.virtual.friction is not None
    return friction_curve_Nm(friction_constants(config.virtual.friction, 121.0), velocity_radps)
