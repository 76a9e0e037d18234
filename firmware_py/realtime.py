"""The fixed-rate loop: one compiled function from before enabling until every drive is off.

    sleep until the absolute deadline -> step_cycle

No Python object is touched inside, no memory is allocated, the GIL is not held.  An overrun skips slots and keeps
the phase of the schedule; it never sends a burst.  The loop ends by itself when every axis is FINISHED.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jointctl.firmware_py.cycle import Clock, CycleMemory, Exchange, Slot, Word, load_word, step_cycle, store_word
from jointctl.firmware_py.kernel import kernel, shared
from jointctl.firmware_py.libc import boottime_ns, monotonic_ns, sleep_until_ns


@kernel
def slept_ns(words: np.ndarray, timespec: np.ndarray) -> int:
    """How long the computer has slept since ASLEEP_NS was written; 0 there: since the first call.

    CLOCK_MONOTONIC stands still then, so that no deadline shows it.  Between two readings the processor may be
    lost: with this order the slept time then seems shorter, never longer, and the next cycle sees it.
    """
    before_ns = load_word(words, Word.ASLEEP_NS)
    if before_ns == 0:
        start_ns = monotonic_ns(timespec)
        store_word(words, Word.ASLEEP_NS, boottime_ns(timespec) - start_ns)
        return 0
    boot_ns = boottime_ns(timespec)
    return boot_ns - monotonic_ns(timespec) - before_ns


@shared
def run_cycles(
    memory: CycleMemory,
    exchange: Exchange,
    clock: Clock,
    sleep_until_ns: Callable[[int, np.ndarray], None],
    period_ns: int,
    receive_ns: int,
    max_cycles: int,
) -> int:
    """Run until FINISHED or `max_cycles` slots; returns the number of cycles executed.

    `sleep_until_ns` (deadline_ns, timespec) waits; `receive_ns` is how long a cycle may wait for its sample, counted
    from the deadline.  In plain Python this is the portable loop.
    """
    executed = 0
    last_slot_ns = clock.now_ns(memory.timespec)
    deadline_ns = last_slot_ns + period_ns
    while executed < max_cycles:
        sleep_until_ns(deadline_ns, memory.timespec)
        wake_ns = clock.now_ns(memory.timespec)
        late_ns = wake_ns - deadline_ns
        if late_ns >= period_ns:
            deadline_ns += late_ns // period_ns * period_ns
        elapsed_cycles = (deadline_ns - last_slot_ns) // period_ns
        last_slot_ns = deadline_ns
        slot = Slot(period_ns, deadline_ns, wake_ns, late_ns, elapsed_cycles, deadline_ns + receive_ns)
        executed += 1
        if step_cycle(memory, exchange, clock, slot):
            break
        deadline_ns += period_ns
    return executed


@kernel
def run_loop(memory: CycleMemory, exchange: Exchange, period_ns: int, receive_ns: int, max_cycles: int) -> int:
    """`run_cycles` on the computer's clock.  With max_cycles = 0 nothing is sent: that call compiles."""
    clock = Clock(monotonic_ns, slept_ns)
    return run_cycles(memory, exchange, clock, sleep_until_ns, period_ns, receive_ns, max_cycles)
