"""Studies and campaigns on a cluster: a real scheduler with real workers on the loopback address.

The results are those of this computer to the bit, also where a worker is killed on the way.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import DataError, JointctlError, UsageError
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.experiments import many_runs
from jointctl.tools.experiments.campaign import Campaign, run_campaign
from jointctl.tools.experiments.controller_study import StudySettings, run_study
from jointctl.tools.experiments.many_runs import Workers, require_protected
from jointctl.tools.experiments.scenarios import named
from tests.browser import free_port

needs_distributed = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="not installed: distributed (extra `cluster`)"
)
PROGRAM = "from dask.__main__ import main; main()"


class Cluster:
    """Scheduler and workers, each a process of its own."""

    def __init__(self, folder: Path, certificates: Sequence[str] = ()) -> None:
        scheme = "tls" if certificates else "tcp"
        self.address, self._folder, self._certificates = f"{scheme}://127.0.0.1:{free_port()}", folder, certificates
        self.processes: list[subprocess.Popen[bytes]] = []
        port = self.address.rpartition(":")[2]
        self._start("scheduler", "--protocol", scheme, "--host", "127.0.0.1", "--port", port, "--no-dashboard")

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{words[0]}-{len(self.processes)}").open("wb") as log:
            command = [sys.executable, "-P", "-c", PROGRAM, *words, *self._certificates]
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder, start_new_session=True)
        self.processes.append(process)
        return process

    def worker(self, name: str) -> subprocess.Popen[bytes]:
        return self._start("worker", self.address, "--name", name, "--nthreads", "1", "--no-dashboard", "--no-nanny")

    def wait_for(self, workers: int) -> None:
        from distributed import Client

        with Client(self.address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=60)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    found = Cluster(tmp_path)
    yield found
    found.close()


def verdicts_of(workers: Workers, count: int, advance: Any = lambda done: None) -> list[tuple[Any, ...]]:
    found, _, interrupted = run_campaign(Campaign(load_config(shipped_config("virtual")), 9), count, advance, workers)
    assert not interrupted
    return [dataclasses.astuple(verdict) for verdict in found]


@needs_distributed
def test_a_campaign_on_two_workers_of_which_one_is_killed_is_the_one_of_this_computer(cluster: Cluster) -> None:
    doomed = cluster.worker("doomed")
    cluster.worker("other")
    cluster.wait_for(2)
    progress: list[float] = []

    def advance(done: float) -> None:
        progress.append(done)
        if len(progress) == 2:  # both are at work, and have more to do
            doomed.send_signal(signal.SIGKILL)
            doomed.wait()

    found = verdicts_of(Workers(cluster=cluster.address), 160, advance)
    assert [verdict[0] for verdict in found] == list(range(160))  # none lost, none twice
    assert progress == [16.0 * k for k in range(1, 11)]
    assert found == verdicts_of(Workers(1), 160)


@needs_distributed
def test_a_study_on_a_cluster_is_the_one_of_this_computer(cluster: Cluster) -> None:
    for name in "ab":
        cluster.worker(name)
    cluster.wait_for(2)
    base = load_config(shipped_config("precise"))
    base = base.changed(trajectory__duration_s=3.0)
    results = [
        run_study(base, named(("paper", "pid")), StudySettings(plants=5, seed=4, after_s=1.0), workers=workers)
        for workers in (Workers(cluster=cluster.address), Workers(1))
    ]
    assert results[0] == results[1]


@needs_distributed
def test_a_worker_of_another_version_is_refused_by_name(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cluster.worker("same")
    cluster.wait_for(1)
    monkeypatch.setattr(many_runs, "VERSION", "9.9.9")
    with pytest.raises(UsageError, match=r"jointctl 9\.9\.9 here, but tcp://127\.0\.0\.1:\d+: 0\.") as caught:
        verdicts_of(Workers(cluster=cluster.address), 16)
    assert caught.value.exit_code == 2
    # one that comes later refuses the task itself
    with pytest.raises(UsageError, match=r"jointctl 9\.9\.9, but the runs are of 0\.0\.1"):
        many_runs._same_version("0.0.1", abs, -1)


@needs_distributed
def test_other_sources_or_processors_are_a_remark(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    cluster.worker("same")
    cluster.wait_for(1)
    warned: list[str] = []
    assert len(verdicts_of(Workers(cluster=cluster.address, warn=warned.append), 1)) == 1
    assert warned == []
    monkeypatch.setattr(many_runs, "source_hash", lambda: "another")
    verdicts_of(Workers(cluster=cluster.address, warn=warned.append), 1)
    assert len(warned) == 1
    assert "the last bits may as well" in warned[0]


@needs_distributed
def test_a_scheduler_without_workers_and_no_scheduler_are_told(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match="the scheduler has no workers"):
        verdicts_of(Workers(cluster=cluster.address), 1)
    monkeypatch.setattr(many_runs, "CONNECT_S", 0.5)
    with pytest.raises(JointctlError, match="no scheduler answers"):
        verdicts_of(Workers(cluster=f"tcp://127.0.0.1:{free_port()}"), 1)


@needs_distributed
def test_an_interruption_keeps_what_is_done_and_leaves_the_workers_free(cluster: Cluster) -> None:
    cluster.worker("one")
    cluster.wait_for(1)

    def advance(done: float) -> None:
        raise KeyboardInterrupt

    config = load_config(shipped_config("virtual"))
    found, _, interrupted = run_campaign(Campaign(config, 9), 3200, advance, Workers(cluster=cluster.address))
    assert interrupted
    assert len(found) == 16
    started_s = time.monotonic()
    assert len(verdicts_of(Workers(cluster=cluster.address), 1)) == 1
    assert time.monotonic() - started_s < 30.0  # the 3184 others are not carried out first


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:8786", "tcp://localhost:1", "tcp://[::1]:8786", "tls://10.0.0.5:8786"]
)
def test_on_this_computer_or_with_tls_needs_no_word_more(address: str) -> None:
    require_protected(address, unprotected=False)


def test_an_unprotected_scheduler_elsewhere_needs_a_word() -> None:
    with pytest.raises(UsageError, match=r"--cluster \(=tcp://10\.0\.0\.5:8786\) must be tls://, or on this computer"):
        require_protected("tcp://10.0.0.5:8786", unprotected=False)
    require_protected("tcp://10.0.0.5:8786", unprotected=True)


@pytest.mark.parametrize("address", ["", "127.0.0.1:8786", "http://h:1", "tcp://h", "tcp://:5", "tcp://h:99999"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="must be tcp://HOST:PORT or tls://HOST:PORT"):
        require_protected(address, unprotected=True)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(DataError, match="the extra `cluster`"):
        verdicts_of(Workers(cluster="tcp://127.0.0.1:8786"), 1)


def certificates(folder: Path) -> dict[str, str]:
    """An authority, and one certificate of it for all ends, as dask names them."""

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    new_key = ("-newkey", "rsa:2048", "-nodes")
    openssl("req", "-x509", *new_key, "-keyout", "ca.key", "-out", "ca.pem", "-days", "1", "-subj", "/CN=ca")
    openssl("req", *new_key, "-keyout", "node.key", "-out", "node.csr", "-subj", "/CN=node")
    openssl(
        "x509", "-req", "-in", "node.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-out", "node.pem"
    )
    names = {"ca-file": "ca.pem", "client.cert": "node.pem", "client.key": "node.key"}
    return {f"distributed.comm.tls.{key}": str(folder / name) for key, name in names.items()}


@needs_distributed
@pytest.mark.skipif(shutil.which("openssl") is None, reason="not installed: openssl")
def test_over_tls_the_results_are_the_same_and_nobody_comes_in_without_a_certificate(tmp_path: Path) -> None:
    import dask

    ours = certificates(tmp_path)
    authority, certificate, key = ours.values()
    cluster = Cluster(tmp_path, ("--tls-ca-file", authority, "--tls-cert", certificate, "--tls-key", key))
    try:
        cluster.worker("a")
        with dask.config.set(ours):
            cluster.wait_for(1)
            assert verdicts_of(Workers(cluster=cluster.address), 16) == verdicts_of(Workers(1), 16)
        with pytest.raises(UsageError, match="DASK_DISTRIBUTED__COMM__TLS__CA_FILE is not set"):
            verdicts_of(Workers(cluster=cluster.address), 1)
        for given in ({"distributed.comm.tls.client.cert": authority}, {"distributed.comm.tls.ca-file": "/nowhere"}):
            with (
                dask.config.set(ours | given),
                pytest.raises(UsageError, match=r"cannot be used: .*(mismatch|No such)"),
            ):
                verdicts_of(Workers(cluster=cluster.address), 1)
    finally:
        cluster.close()
