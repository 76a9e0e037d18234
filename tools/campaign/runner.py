"""Many scenarios on all cores.  What is done is kept whatever ends the campaign."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.campaign.judge import Verdict, judge
from tools.campaign.scenario import draw_scenario
from tools.configuration.config import Config
from tools.configuration.load import load_config
from tools.simulation.lockstep import LockstepJoint
from tools.simulation.workers import interrupts_left_to_the_parent

AT_ONCE = 16  # scenarios that a worker takes at a time
_worker: dict[str, object] = {}


def _begin(path: str, seed: int) -> None:
    """In each worker: commission a joint of its own."""
    config = load_config(path)
    _worker.update(config=config, joint=LockstepJoint(config), seed=seed)


def _work(number: int) -> Verdict:
    config, joint, seed = _worker["config"], _worker["joint"], _worker["seed"]
    assert isinstance(config, Config)
    assert isinstance(joint, LockstepJoint)
    assert isinstance(seed, int)
    return judge(config, joint, draw_scenario(seed, number))


def _verdicts(path: Path, seed: int, count: int, workers: int) -> Iterator[Verdict]:
    if workers == 1:
        config = load_config(path)
        joint = LockstepJoint(config)
        for number in range(count):
            yield judge(config, joint, draw_scenario(seed, number))
        return
    context = multiprocessing.get_context("spawn")
    with interrupts_left_to_the_parent():
        started = context.Pool(workers, _begin, (str(path), seed))
    with started as pool:
        yield from pool.imap_unordered(_work, range(count), AT_ONCE)


def run_campaign(
    path: Path, seed: int, count: int, advance: Callable[[float], None], workers: int | None = None
) -> tuple[list[Verdict], float, bool]:
    """(verdicts in order of their numbers, time taken [s], whether Ctrl-C ended it early)."""
    started_s = time.monotonic()
    found: list[Verdict] = []
    interrupted = False
    try:
        for verdict in _verdicts(path, seed, count, workers or os.cpu_count() or 1):
            found.append(verdict)
            advance(float(len(found)))
    except KeyboardInterrupt:
        interrupted = True
    return sorted(found, key=lambda verdict: verdict.number), time.monotonic() - started_s, interrupted
