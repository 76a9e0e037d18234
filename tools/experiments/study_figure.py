"""Box plots of a study: peak, RMSE and settling time of every controller, logarithmic."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DataError
from tools.experiments.study_runs import StudyResult

_PANELS = (
    ("peak_mrad", "peak error [mrad]"),
    ("rmse_mrad", "RMSE [mrad]"),
    ("true_rmse_mrad", "RMSE of the joint\nitself [mrad]"),
)
_BLUE, _GREY = "#1f5fa8", "#555555"


def save_study_figure(result: StudyResult, path: Path, title: str) -> Path:
    """The picture of `study_png` as a file; returns the path."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(study_png(result, title))
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path


def study_png(result: StudyResult, title: str) -> bytes:
    """The boxes (quartiles; whiskers 5 and 95 %; dots beyond) as PNG."""
    # slow to import, and only wanted here; no display is needed
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(result.controllers)
    figure = Figure(figsize=(12.0, 1.8 + 0.42 * count), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(_PANELS), sharey=True)
    for axis, (key, label) in zip(axes, _PANELS, strict=True):
        _boxes(axis, result, key)
        axis.set_xscale("log")
        axis.set_xlabel(label)
        axis.grid(True, which="both", axis="x", color="#e4e4e4", linewidth=0.5)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yticks(range(1, count + 1), [name.replace("_", " ") for name in result.controllers])
    axes[0].invert_yaxis()
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    data = io.BytesIO()
    figure.savefig(data, dpi=110, format="png")
    return data.getvalue()


def _boxes(axis: Any, result: StudyResult, key: str) -> None:
    drawn = [result.values(name, key) for name in result.controllers]
    axis.boxplot(
        [values[np.isfinite(values)] for values in drawn],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.6,
        boxprops={"color": _BLUE},
        medianprops={"color": "black", "linewidth": 1.6},
        whiskerprops={"color": _BLUE},
        capprops={"color": _BLUE},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": _GREY},
    )
