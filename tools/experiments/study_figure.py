"""Box plots of a study: peak, RMSE and settling time of every controller, logarithmic."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.tools.drawing import BLUE, GREY, INK, canvas
from jointctl.tools.experiments.study_runs import StudyResult

_PANELS = (
    ("peak_mrad", "peak error [mrad]"),
    ("rmse_mrad", "RMSE [mrad]"),
    ("true_rmse_mrad", "RMSE of the joint\nitself [mrad]"),
)


def study_figure(result: StudyResult, title: str) -> Any:
    """The boxes: quartiles; whiskers 5 and 95 %; dots beyond."""
    count = len(result.controllers)
    with canvas(1.8 + 0.42 * count, title) as figure:
        axes = figure.subplots(1, len(_PANELS), sharey=True)
        for axis, (key, label) in zip(axes, _PANELS, strict=True):
            _boxes(axis, result, key)
            axis.set_xscale("log")
            axis.set_xmargin(0.04)
            axis.set_xlabel(label)
            axis.grid(True, which="both", axis="x", linewidth=0.5)
            axis.grid(False, axis="y")
        axes[0].set_yticks(range(1, count + 1), [name.replace("_", " ") for name in result.controllers])
        axes[0].invert_yaxis()
        return figure


def _boxes(axis: Any, result: StudyResult, key: str) -> None:
    drawn = [result.values(name, key) for name in result.controllers]
    axis.boxplot(
        [values[np.isfinite(values)] for values in drawn],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.6,
        boxprops={"color": BLUE},
        medianprops={"color": INK, "linewidth": 1.6},
        whiskerprops={"color": BLUE},
        capprops={"color": BLUE},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": GREY},
    )
