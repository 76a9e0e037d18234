"""The loops of section 4 of the control specification."""

from __future__ import annotations

from dataclasses import replace

from jointctl.firmware_py.states import ControllerKind
from jointctl.tools.analysis.linear_loop import LoopSettings

_HALF = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
CENTRES = tuple((c, c) for c in (*_HALF, 0.0, *(-c for c in _HALF)))
Q1800 = LoopSettings(
    kind=ControllerKind.COMPUTED_TORQUE_RBF,
    period_s=1e-3,
    delay_s=1e-3,
    lag_s=0.5e-3,
    inertia_kgm2=2.1,
    kp=784.0,
    kv=56.0,
    cutoff_Hz=100.0,
    q=(1800.0, 1800.0),
    learning_rate=80.0,
    centres=CENTRES,
    widths=(5.0,) * 15,
    weight_Nm=0.01,
)
Q2500 = replace(Q1800, q=(2500.0, 2500.0))
ANY_KIND = (
    Q1800,
    replace(Q1800, kind=ControllerKind.COMPUTED_TORQUE),
    replace(Q1800, kind=ControllerKind.PID, kp=3 * 45.0**2, kv=3 * 45.0, ki=45.0**3),
    replace(Q1800, kind=ControllerKind.COMPUTED_TORQUE_OBSERVER, observer_radps=60.0, observer_delay_cycles=1),
)
