"""Many simulated runs at once: on the processors of this computer, or on those of a cluster (dask.distributed).

Either is an executor of `concurrent.futures`; what comes back belongs to its task, on which worker it ran and how
often: a task whose worker died is done again by another one, and counts once.  A run is drawn from seed and number, so
that a study or campaign on a cluster is the one that it is here.
"""

from __future__ import annotations

import ipaddress
import multiprocessing
import platform
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from types import ModuleType
from typing import Any, TypeVar
from urllib.parse import urlsplit

from jointctl.drivers.errors import DataError, JointctlError, UsageError
from jointctl.firmware_py.kernel import source_hash
from jointctl.tools.child_process import interrupts_left_to_the_parent, processors

PENDING = 4  # tasks that are handed out for each processor, so that none waits for the next one
CONNECT_S = 10.0
RISK = "anyone who reaches an unprotected scheduler runs programs on its workers: docs/cluster.md"

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """Where the runs are carried out: `count` processes here (None: one a processor), or on a cluster."""

    count: int | None = None
    cluster: str | None = None  # address of its scheduler
    unprotected: bool = False  # whether it may be one without TLS on another computer
    warn: Callable[[str], None] = lambda text: None

    def results(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Generator[Result, None, None]:
        """`function` of each task, in the order in which they are done; closing it ends the work early."""
        left = iter(tasks)
        if self.cluster is None:  # what the first one compiles the processes load, and only here can it be said
            yield from map(function, left if self.count == 1 else islice(left, 1))
            if self.count == 1:
                return
        with self._executor() as (executor, at_once):
            pending: set[Future[Result]] = set()
            while True:
                with (
                    interrupts_left_to_the_parent(),
                    _without_main(function),
                ):  # the processes start with the first tasks
                    pending |= {executor.submit(_same_version, VERSION, function, task)
                                for task in islice(left, at_once - len(pending))}  # fmt: skip
                if not pending:
                    return
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()

    @contextmanager
    def _executor(self) -> Iterator[tuple[Executor, int]]:
        """With the number of tasks that are handed out at once."""
        with _of_cluster(self) if self.cluster is not None else _of_this_computer(self.count or processors()) as found:
            yield found


HERE = Workers()
VERSION = version("jointctl")


def _same_version(wanted: str, function: Callable[[Task], Result], task: Task) -> Result:
    """The task's result; a worker of another version, which may come at any time, refuses it."""
    if wanted != VERSION:
        raise UsageError(f"worker on {platform.node()}: jointctl {VERSION}, but the runs are of {wanted}")
    return function(task)


@contextmanager
def _of_this_computer(count: int) -> Iterator[tuple[Executor, int]]:
    """Spawned, not forked: nothing of this process (threads, open buses) is to be inherited."""
    before = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))
    ended = False
    try:
        yield executor, PENDING * count
        ended = True
    finally:
        # after an interruption or an error nobody wants the runs that are still being simulated
        executor.shutdown(wait=ended, cancel_futures=True)
        if not ended:
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()


@contextmanager
def _without_main(function: Callable[..., Any]) -> Iterator[None]:
    """A spawned process runs the file of `__main__` again: only where `function` is in it.

    A user's program, whose calls the processes would repeat, may have moved joints before.
    """
    main = sys.modules["__main__"]
    if function.__module__ != "__main__":
        sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


# --- a cluster ---


def require_protected(address: str, unprotected: bool) -> None:
    """`UsageError` for an address that is none, or that of an unprotected scheduler on another computer."""
    parts = urlsplit(address)
    try:
        named = parts.scheme in ("tcp", "tls") and bool(parts.hostname) and parts.port is not None
    except ValueError:
        named = False
    if not named:
        raise UsageError(f"--cluster (={address}) must be tcp://HOST:PORT or tls://HOST:PORT")
    if parts.scheme == "tcp" and not unprotected and not _is_loopback(str(parts.hostname)):
        raise UsageError(f"--cluster (={address}) must be tls://, or on this computer; {RISK}",
                         "--cluster-unprotected, in a network where no one else is")  # fmt: skip


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@contextmanager
def _of_cluster(workers: Workers) -> Iterator[tuple[Executor, int]]:
    """The executor of a scheduler whose workers have this version; what is still pending is cancelled at the end."""
    address = str(workers.cluster)
    require_protected(address, workers.unprotected)
    try:
        import distributed
    except ImportError:
        hint = "in a clone: pip install -e '.[cluster]'"
        raise DataError("--cluster needs the extra `cluster` (distributed), which is not installed", hint) from None
    if urlsplit(address).scheme == "tls":
        _require_certificates(address, distributed.Security())
    try:
        client: Any = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:
        raise JointctlError(f"--cluster (={address}): no scheduler answers: {error}", "docs/cluster.md") from None
    try:
        threads = _fit_workers(client, address, workers.warn)
        executor = client.get_executor(pure=False)
        try:
            yield executor, PENDING * threads
        finally:
            executor.shutdown(wait=False)
    finally:
        client.close()


def _require_certificates(address: str, security: Any) -> None:
    """A client without them cannot even be closed again."""
    for name, given in (("CA_FILE", security.tls_ca_file), ("CLIENT__CERT", security.tls_client_cert)):
        if given is None:
            variable = f"DASK_DISTRIBUTED__COMM__TLS__{name}"
            raise UsageError(f"--cluster (={address}) needs certificates, and {variable} is not set", "docs/cluster.md")
    try:
        security.get_connection_args("client")
    except (OSError, ValueError) as error:
        files = f"{security.tls_ca_file}, {security.tls_client_cert}, {security.tls_client_key}"
        raise UsageError(f"--cluster (={address}): the certificates in {files} cannot be used: {error}") from None


def _about() -> tuple[str, str]:
    """Of a worker: version, and what decides on the last bits of a result."""
    return VERSION, source_hash()


def _fit_workers(client: Any, address: str, warn: Callable[[str], None]) -> int:
    """How many tasks the workers carry out at once; `UsageError` names those with another version."""
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise UsageError(f"--cluster (={address}): the scheduler has no workers", "`dask worker` starts some")
    ours = _about()
    found = client.run(_about, on_error="return")
    other = [f"{name}: {'no jointctl' if isinstance(about, Exception) else about[0]}"
             for name, about in found.items() if isinstance(about, Exception) or about[0] != ours[0]]  # fmt: skip
    if other:
        raise UsageError(f"--cluster: jointctl {ours[0]} here, but {', '.join(other)}")
    if differing := [name for name, about in found.items() if about != ours]:
        warn(
            f"{', '.join(differing)}: sources, Python or type of processor differ from here: the last bits may as well"
        )
    return sum(threads.values())
