"""The paper's figures 8 to 14, redrawn from our runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.tools.drawing import BLUE, GREEN, GREY, ORANGE, RED, canvas
from jointctl.tools.experiments.paper_experiments import Runs, friction_estimate, hidden_outputs
from jointctl.tools.experiments.scenarios import event_s
from jointctl.tools.lockstep import LockstepRun
from jointctl.tools.recording.run_figure import drawn_indices

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_START_s = 1.0


def _draw(axis: Axes, time_s: np.ndarray, values: np.ndarray, label: str = "", color: str = BLUE, **style: Any) -> None:
    keep = drawn_indices(values)
    axis.plot(time_s[keep], values[keep], label=label, color=color, **{"linewidth": 1.0, **style})


def _tidy(axis: Axes, ylabel: str, title: str, *, legend: bool = False) -> None:
    axis.set_ylabel(ylabel)
    axis.set_title(title)
    if legend:
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _scale_to_later(axis: Axes, *curves: tuple[np.ndarray, np.ndarray]) -> None:
    """Limits of the axis from what comes after the first second: the start at rest would hide the rest."""
    later = np.concatenate([values[time_s > _START_s] for time_s, values in curves])
    low, high = float(np.min(later)), float(np.max(later))
    room = 0.08 * (high - low) or 1.0
    axis.set_ylim(low - room, high + room)


def _draw_nodes(
    axis: Axes, time_s: np.ndarray, values: np.ndarray, letter: str, widths: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> None:
    """Three of the network's nodes, (N, nodes): the first, the middle, the last."""
    for index, color, width in zip((0, 7, 14), (BLUE, ORANGE, GREEN), widths, strict=True):
        _draw(axis, time_s, values[:, index], f"{letter}{index + 1}", color, linewidth=width)
    _scale_to_later(axis, *((time_s, values[:, index]) for index in (0, 7, 14)))


def _draw_precise(axis: Axes, time_s: np.ndarray, error_rad: np.ndarray, on: str = "") -> None:
    _draw(axis, time_s, error_rad * 1e3, "precise.toml", GREEN)
    axis.set_ylim(-0.4, 0.4)
    _tidy(axis, "error [mrad]", f"not in the paper: configs/precise.toml{on} (note the scale)", legend=True)


def _over_time(figure: Figure, axes: np.ndarray) -> Figure:
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    return figure


def _tracked(run: LockstepRun) -> tuple[Any, np.ndarray]:
    log = run.log[run.tracking]
    return log, log.trajectory_s


def draw_simulation(runs: Runs) -> Any:
    """Fig. 8: inputs of the network, estimate against truth, weights, hidden outputs."""
    made = runs["4.2 more friction"]
    experiment, run = made.experiment, made.run
    virtual = experiment.plant.virtual
    assert virtual is not None
    log, time_s = _tracked(run)
    title = "Fig. 8: simulation, true friction 10 % above the model, Q = 2500, ideal velocity"
    with canvas(12.0, title) as figure:
        axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 2, 3, 2.4, 2.4))
        _draw(axes[0], time_s, log.error_rad * 1e3)
        start = float(np.max(np.abs(log.error_rad[time_s < _START_s]))) * 1e3
        _tidy(axes[0], "e [mrad]", f"(a) inputs of the network: position error; {start:.2f} mrad in the first instant")
        _draw(axes[1], time_s, log.error_rate_radps * 1e3, color=ORANGE)
        axes[1].set_ylim(-12.0, 12.0)
        first = float(log.error_rate_radps[0]) * 1e3
        _tidy(axes[1], "e' [mrad/s]", f"(a) velocity error; it begins at {first:.0f} mrad/s, the joint being at rest")
        estimate = friction_estimate(run, virtual.friction_positive_scale, virtual.friction_negative_scale)
        _draw(axes[2], time_s, estimate.true_Nm, "true model error f", GREY, linewidth=1.6)
        _draw(axes[2], time_s, estimate.estimate_Nm, "estimate", RED)
        text = f"(b) estimated and true model error; after 75 s correlation {estimate.correlation:.3f}"
        _scale_to_later(axes[2], (time_s, estimate.true_Nm), (time_s, estimate.estimate_Nm))
        _tidy(axes[2], "[Nm]", text, legend=True)
        # all weights move as one (b = 5), so that only lines of different widths are seen
        _draw_nodes(axes[3], time_s, log.weights, "w", (2.6, 1.97, 1.34))
        _tidy(axes[3], "[Nm]", "(c) weights: they differ by less than a line's width", legend=True)
        hidden = hidden_outputs(run, experiment.plant, experiment.controller)
        _draw_nodes(axes[4], time_s, hidden, "h")
        axes[4].ticklabel_format(axis="y", useOffset=False)
        _tidy(axes[4], "", "(d) outputs of the hidden layer: near 1 throughout", legend=True)
        return _over_time(figure, axes)


def draw_friction_model(runs: Runs) -> Any:
    """Figs. 9 to 11: with and without friction model on R1."""
    without, with_model, precise = (runs[key].run for key in ("no model, R1", "model, R1", "precise, R1"))
    with canvas(12.0, "Figs. 9-11: with and without friction model, realistic joint R1, Q = 1800") as figure:
        axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 2.4, 2.4, 2.4, 2))
        log, time_s = _tracked(with_model)
        bare, bare_s = _tracked(without)
        fine, fine_s = _tracked(precise)
        _draw(axes[0], time_s, log.desired_position_rad, "desired", ORANGE, linewidth=2.2)
        _draw(axes[0], time_s, log.position_rad, "with model", BLUE)
        _draw(axes[0], bare_s, bare.position_rad, "without", GREY, linestyle="--")
        _tidy(axes[0], "joint angle [rad]", "tracking", legend=True)
        _draw(axes[1], bare_s, bare.network_torque_Nm, "without", GREY)
        _draw(axes[1], time_s, log.network_torque_Nm, "with model", RED)
        _scale_to_later(axes[1], (bare_s, bare.network_torque_Nm), (time_s, log.network_torque_Nm))
        _tidy(axes[1], "network [Nm]", "output of the network, subtracted from the torque", legend=True)
        _draw(axes[2], bare_s, bare.error_rad * 1e3, "without", GREY)
        _draw(axes[2], time_s, log.error_rad * 1e3, "with model", BLUE)
        _scale_to_later(axes[2], (bare_s, bare.error_rad * 1e3), (time_s, log.error_rad * 1e3))
        _tidy(axes[2], "error [mrad]", "error; the first instants, from rest, are cut off", legend=True)
        _draw(axes[3], time_s, log.command_torque_Nm, "with model", BLUE)
        _draw(axes[3], bare_s, bare.command_torque_Nm, "without", GREY)
        _scale_to_later(axes[3], (bare_s, bare.command_torque_Nm), (time_s, log.command_torque_Nm))
        _tidy(axes[3], "torque [Nm]", "torque at the joint", legend=True)
        _draw_precise(axes[4], fine_s, fine.error_rad, " on the same joint")
        return _over_time(figure, axes)


def draw_change(runs: Runs, change: str, title: str, from_s: float = 70.0) -> Any:
    """Figs. 12 to 14: tracking, network, error around a change; the precise law beside it."""
    made, other = runs[f"{change}, R1"], runs[f"precise, {change}, R1"]
    log, time_s = _tracked(made.run)
    fine, fine_s = _tracked(other.run)
    with canvas(9.5, title) as figure:
        axes = figure.subplots(4, 1, sharex=True, height_ratios=(2, 2, 2.4, 2))
        late, fine_late = time_s >= from_s, fine_s >= from_s
        t = time_s[late]
        _draw(axes[0], t, log.desired_position_rad[late], "desired", ORANGE, linewidth=2.2)
        _draw(axes[0], t, log.position_rad[late], "measured", BLUE)
        _tidy(axes[0], "joint angle [rad]", "(a) tracking", legend=True)
        _draw(axes[1], t, log.network_torque_Nm[late], "paper's law", RED)
        _tidy(axes[1], "network [Nm]", "(b) output of the network, subtracted", legend=True)
        _draw(axes[2], t, log.error_rad[late] * 1e3, "paper's law", BLUE)
        _tidy(axes[2], "error [mrad]", "(c) error", legend=True)
        _draw_precise(axes[3], fine_s[fine_late], fine.error_rad[fine_late])
        at_s = event_s(made.experiment.scenario)
        for axis in axes:
            axis.axvline(at_s, color=GREY, linewidth=1.0, linestyle=":")
        return _over_time(figure, axes)


def draw_all(runs: Runs) -> dict[str, Any]:
    """Every figure of the runs by the name of its file, in the paper's order."""
    return {
        "fig08_simulation": draw_simulation(runs),
        "fig09_11_friction_model": draw_friction_model(runs),
        "fig12_frequency": draw_change(runs, "frequency", "Fig. 12: frequency change at 82.5 s, R1"),
        "fig13_amplitude": draw_change(runs, "amplitude", "Fig. 13: amplitude change at 82.5 s, R1"),
        "fig14_load": draw_change(runs, "load", "Fig. 14: load step of 3 Nm at 80 s, R1"),
    }
