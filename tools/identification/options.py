"""What an identification is told: the flags of `jointctl identify`, and what of them is allowed."""

from __future__ import annotations

from dataclasses import dataclass, field

from jointctl.drivers.errors import UsageError
from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.pso import SwarmSettings

SLOWEST_degps, FASTEST_degps = 1e-4, 6e4
STATIC_MAX_Nm = 1e3  # at the motor
MODELS = ("multi-stage", "stribeck", "coulomb-viscous", "auto")


@dataclass(frozen=True)
class Options:
    """What to fit and how; speeds in joint rad/s."""

    model: str = "multi-stage"
    continuous: bool = False
    search_knee: bool = False
    knee_radps: float = 40.0 * DEGREE
    ws_min_radps: float | None = None  # None: a third of the lowest speed
    ws_max_radps: float = 20.0 * DEGREE
    static_max_Nm: float | None = None  # None: 1.25 times the greatest friction near zero speed
    outlier_threshold: float = 5.0
    folds: int = 10
    swarm: SwarmSettings = field(default_factory=SwarmSettings)

    def check(self) -> None:
        """Raise `UsageError` for a value out of range."""
        s = self.swarm
        for name, value, low, high in (
            ("--outlier-threshold", self.outlier_threshold, 0.0, 100.0), ("--folds", self.folds, 2, 100),
            ("--particles", s.particles, 2, 100_000), ("--iterations", s.iterations, 1, 1_000_000),
            ("--inertia", s.inertia, 0.0, 1.0), ("--cognitive", s.cognitive, 0.0, 4.0),
            ("--social", s.social, 0.0, 4.0), ("--seed", s.seed, 0, 2**63 - 1), ("--stall", s.stall, 0, 1_000_000),
        ):  # fmt: skip
            if not low <= value <= high:
                raise UsageError(f"{name} (={value:g}) must be in [{low:g}..{high:g}]")
        # as they are given on the command line: in deg/s
        for name, value_radps in (("--knee", self.knee_radps), ("--ws-max", self.ws_max_radps)):
            if not SLOWEST_degps <= value_radps / DEGREE <= FASTEST_degps:
                allowed = f"[{SLOWEST_degps:g}..{FASTEST_degps:g}] deg/s"
                raise UsageError(f"{name} (={value_radps / DEGREE:g} deg/s) must be in {allowed}")
        if self.ws_min_radps is not None and not 0.0 < self.ws_min_radps < self.ws_max_radps:
            allowed = f"(0..{self.ws_max_radps / DEGREE:g}) deg/s"
            raise UsageError(f"--ws-min (={self.ws_min_radps / DEGREE:g} deg/s) must be in {allowed}")
        if self.static_max_Nm is not None and not 0.0 < self.static_max_Nm <= STATIC_MAX_Nm:
            raise UsageError(f"--static-max (={self.static_max_Nm:g} Nm) must be in (0..{STATIC_MAX_Nm:g}]")
        if self.model not in MODELS:
            raise UsageError(f"--model (={self.model}) must be one of {', '.join(MODELS)}")
