"""Many scenarios on all cores.  What is done is kept whatever ends the campaign."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jointctl.tools.campaign.judge import Verdict, judge
from jointctl.tools.campaign.scenario import draw_scenario
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.simulation.child_process import interrupts_left_to_the_parent
from jointctl.tools.simulation.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import with_mode

AT_ONCE = 16  # scenarios that a worker takes at a time
_worker: dict[str, object] = {}


def campaign_joint(config: Config, *, sweep: bool) -> tuple[Config, LockstepJoint]:
    """The configuration in the mode of the drive that a run, or a sweep, uses, and its joint, commissioned."""
    config = with_mode(config, "auto") if sweep else config
    return config, LockstepJoint(config)


def _begin(path: str, seed: int, sweep: bool) -> None:
    """In each worker: commission a joint of its own."""
    config, joint = campaign_joint(load_config(path), sweep=sweep)
    _worker.update(config=config, joint=joint, seed=seed, sweep=sweep)


def _work(number: int) -> Verdict:
    config, joint, seed = _worker["config"], _worker["joint"], _worker["seed"]
    assert isinstance(config, Config)
    assert isinstance(joint, LockstepJoint)
    assert isinstance(seed, int)
    return judge(config, joint, draw_scenario(seed, number, sweep=bool(_worker["sweep"])))


def _verdicts(path: Path, seed: int, count: int, workers: int, sweep: bool) -> Iterator[Verdict]:
    if workers == 1:
        config, joint = campaign_joint(load_config(path), sweep=sweep)
        for number in range(count):
            yield judge(config, joint, draw_scenario(seed, number, sweep=sweep))
        return
    context = multiprocessing.get_context("spawn")
    with interrupts_left_to_the_parent():
        started = context.Pool(workers, _begin, (str(path), seed, sweep))
    with started as pool:
        yield from pool.imap_unordered(_work, range(count), AT_ONCE)


def run_campaign(
    path: Path,
    seed: int,
    count: int,
    advance: Callable[[float], None],
    workers: int | None = None,
    *,
    sweep: bool = False,
) -> tuple[list[Verdict], float, bool]:
    """(verdicts in order of their numbers, time taken [s], whether Ctrl-C ended it early)."""
    started_s = time.monotonic()
    found: list[Verdict] = []
    interrupted = False
    try:
        for verdict in _verdicts(path, seed, count, workers or os.cpu_count() or 1, sweep):
            found.append(verdict)
            advance(float(len(found)))
    except KeyboardInterrupt:
        interrupted = True
    return sorted(found, key=lambda verdict: verdict.number), time.monotonic() - started_s, interrupted
