"""Carrying out the check: the loop, supervisor and stops of a run, on a motion and with limits of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.drive import Approval, CommissioningReport
from jointctl.tools.configuration.config import Config
from jointctl.tools.motion_check.plan import CheckPlan, check_constants, config_of_check, motion_table
from jointctl.tools.output import Output
from jointctl.tools.running.control import Control
from jointctl.tools.running.loop.loop_handle import LoopHandle
from jointctl.tools.running.supervisor import Supervisor


class CheckSupervisor(Supervisor):
    """A supervised run of the check; `config` is the user's own."""

    def __init__(
        self,
        config: Config,
        output: Output,
        log_path: Path,
        confirm: Callable[[CommissioningReport], bool],
        plan: CheckPlan,
        control: Control,
        approve: Approval | None,
    ) -> None:
        super().__init__(config_of_check(config, plan), output, log_path, confirm, control, approve=approve)
        self._plan = plan

    def _table(self) -> np.ndarray:
        return motion_table(self._plan, 0.0)

    def _constants(self, loop: LoopHandle, report: CommissioningReport) -> Any:
        table = motion_table(self._plan, report.start_position_rad)
        loop.block.table[:] = table
        return check_constants(self._config, self._plan, report, table)
