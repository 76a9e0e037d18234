"""Which tests run when: the markers `realtime` and `parties` go with the folder, `slow` stands at the test."""

from __future__ import annotations

from pathlib import Path

FOLDERS = {"hil": "realtime", "faults": "realtime", "docs": "realtime", "socketcan": "realtime", "parties": "parties"}
# in these folders, but at simulated time
LOCKSTEP = tuple(
    f"{folder}/test_{name}.py"
    for folder, names in {
        "hil": "friction_chain law_options map paper_figures random_motions study sweep tune tune_bad_joints",
        "faults": "arm_campaign campaign_configurations every_frame fault_campaign fault_engine fault_regressions"
        " late_samples limit_cycle own_loop_faults unwatched_loop",
        "docs": "configuration_reference notebook reference_pages troubleshooting",
    }.items()
    for name in names.split()
)


def tier_of(path: Path) -> str | None:
    """Marker of the tests in a file, given by its place below tests; None: it runs with the others."""
    if path.as_posix() in LOCKSTEP:
        return None
    return FOLDERS.get(path.parts[0])
