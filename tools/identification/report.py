"""The result of an identification as tables for people."""

from __future__ import annotations

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.friction_data import relative_figures
from jointctl.tools.identification.intervals import NAMES
from jointctl.tools.identification.models import FORMS
from jointctl.tools.identification.result import DIRECTIONS, Identification

_UNITS = {
    "tc": "Nm", "ts": "Nm", "ws": "deg/s", "tv": "Nm s/deg",
    "a0": "Nm", "a1": "Nm s/deg", "a2": "Nm s2/deg2", "a3": "Nm s3/deg3",
}  # fmt: skip
_EXPONENT = {"ws": -1, "tv": 1, "a1": 1, "a2": 2, "a3": 3}


def in_degrees(name: str, value: float, sign: int) -> float:
    """A mirrored SI parameter as (11) prints it: speeds in deg/s, signs of the direction."""
    mirrored = sign if name in ("a0", "a2") else 1
    return mirrored * value * DEGREE ** _EXPONENT.get(name, 0)


def parameter_table(found: Identification) -> Table:
    """Parameters as (11) prints them, with 95 % intervals, one direction below the other."""
    table = Table(title="Friction at the motor, joint velocity in deg/s", title_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("95 % interval", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("weak")
    for word, sign in DIRECTIONS:
        mark = "+" if sign > 0 else "-"
        for name in NAMES:
            interval = found.directions[word].uncertainty.intervals.get(name)
            if interval is None:
                continue
            value, low, high = (in_degrees(name, v, sign) for v in (interval.value, interval.low, interval.high))
            low, high = min(low, high), max(low, high)
            table.add_row(f"{name}{mark}", f"{value:.5g}", f"{low:.4g} .. {high:.4g}", _UNITS[name], interval.weak)
        model = found.directions[word].fit.branch()
        if model.knee_radps < model.max_radps:
            knee = sign * model.knee_radps / DEGREE
            table.add_row(
                f"knee{mark}", f"{knee:.4g}", "searched" if found.options.search_knee else "given", "deg/s", ""
            )
        table.add_section()
    return table


def model_table(found: Identification) -> Table:
    """The models side by side; `held out` is the error on points that the fit did not see."""
    table = Table(title="Models", title_justify="left")
    for title in ("model", "RMSE, mNm", "held out, mNm", "parameters"):
        table.add_column(title, justify="left" if title == "model" else "right")
    for name, rmse in found.rmse_by_model_Nm.items():
        from_swarm = found.rmse_Nm if name == found.model else rmse
        mark = " (chosen)" if name == found.model else ""
        count = len(found.directions) * FORMS[name].parameters
        table.add_row(
            name + mark, f"{1e3 * from_swarm:.4g}", f"{1e3 * found.held_out_by_model_Nm[name]:.4g}", str(count)
        )
    return table


def error_table(errors_Nm: np.ndarray, measured_Nm: np.ndarray, ratio: float) -> Table:
    """Error of a curve on data: motor, joint, relative."""
    table = Table(title="Error", title_justify="left")
    for title in ("", "motor, mNm", "joint, Nm", "relative"):
        table.add_column(title, justify="right" if title else "left")
    rms, greatest, mean = relative_figures(errors_Nm, measured_Nm)
    for word, value, share in (
        ("RMSE", np.sqrt(np.mean(errors_Nm**2)), rms),
        ("greatest", np.max(np.abs(errors_Nm)), greatest),
        ("mean", np.mean(errors_Nm), mean),
    ):
        # a fit's mean error is rounding noise: zero, in the digits that mean something
        motor_mNm, joint_Nm = round(1e3 * value, 9), round(ratio * value, 9)
        table.add_row(word, f"{motor_mNm:z.4g}", f"{joint_Nm:z.4g}", f"{share:z.2%}")
    return table


def identification_report(found: Identification) -> RenderableType:
    table = error_table(found.errors_Nm, found.measured_Nm, found.data.reduction_ratio)
    return Group(parameter_table(found), table, model_table(found), Text("\n".join(_origin(found))))


def _origin(found: Identification) -> list[str]:
    swarm = found.options.swarm
    lines = [f"data SHA-256 {found.data.sha256}"]
    if any(d.swarm is not None for d in found.directions.values()):
        lines.append(f"particle swarm: {swarm.particles} particles x {swarm.iterations} iterations, seed {swarm.seed}")
    for word, d in found.directions.items():
        swarm_text = f"swarm alone {1e3 * d.swarm.fit.rmse_Nm:.4g}, " if d.swarm is not None else ""
        lines.append(
            f"{word}: {len(d.index)} points, RMSE {1e3 * d.fit.rmse_Nm:.4g} mNm from {d.source} "
            f"({swarm_text}least possible {1e3 * d.projected_rmse_Nm:.4g})"
        )
    return lines
