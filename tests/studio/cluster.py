"""A real Slurm on this machine alone: a controller and two nodes of one core, on the loopback device, under root.

Debian's packages slurmctld, slurmd, slurm-client and munge are installed where they are missing. No systemd and no
cgroups are needed. `Cluster.stop` ends every process that was started, also what a node left behind.
"""

import os
import platform
import secrets
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest
from conftest import eventually

NODES = ("n1", "n2")
PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket,cred_expire=5
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/log/slurmctld
SlurmdLogFile={folder}/log/slurmd.%n
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
ReturnToService=2
SlurmdParameters=config_overrides
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=1,sched_min_interval=0,bf_interval=1
SlurmctldTimeout=10
SlurmdTimeout=4
InactiveLimit=0
KillWait=20
JobRequeue=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
AccountingStorageType=accounting_storage/none
NodeName=n[1-2] NodeHostname={host} NodeAddr=127.0.0.1 Port=[{first}-{last}] CPUs=1 RealMemory=4000
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1
PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
"""


def install() -> None:
    """Install what is missing of Slurm; skip the test where that can't be done."""
    if all(shutil.which(name, path="/usr/sbin:/usr/bin") for name in ("slurmctld", "slurmd", "sbatch", "munged")):
        return
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        pytest.skip("Slurm is not installed, and only root can install it by apt-get")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for words in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *PACKAGES]):
        done = subprocess.run(["apt-get", *words], env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"apt-get {words[0]} failed: {done.stderr[-300:]}")


@dataclass
class Cluster:
    """The daemons of a Slurm, in a folder of its own."""

    folder: Path
    port: int
    configuration: Path = field(init=False)

    def __post_init__(self) -> None:
        self.configuration = self.folder / "slurm.conf"

    def start(self) -> None:
        """Start munge, the controller and both nodes, and wait until the nodes are idle."""
        munge = self.folder / "munge"
        for name in ("state", "spool", "log", "munge"):
            (self.folder / name).mkdir()
        for folder in (self.folder, munge):
            folder.chmod(0o755)
        (munge / "key").touch(0o600)
        (munge / "key").write_bytes(secrets.token_bytes(128))
        self.configuration.write_text(
            CONFIGURATION.format(
                folder=self.folder, host=platform.node().split(".")[0], port=self.port, first=self.port + 1,
                last=self.port + 2,
            )
        )  # fmt: skip
        version = self.run("/usr/sbin/slurmd", "-V").split()[-1]
        if version >= "23.11":  # since then it can, and must, be said that there are no cgroups
            (self.folder / "cgroup.conf").write_text("CgroupPlugin=disabled\n")
        self.run(
            "/usr/sbin/munged", "--force", f"--key-file={munge}/key", f"--socket={munge}/socket",
            f"--pid-file={munge}/pid", f"--log-file={munge}/log", f"--seed-file={munge}/seed", "--num-threads=2",
        )  # fmt: skip
        self.run("/usr/sbin/slurmctld", "-f", str(self.configuration))
        for node in NODES:
            self.start_node(node)
        assert eventually(lambda: all(self.state(node) == "idle" for node in NODES), 30), self.run("sinfo", "-N")

    def start_node(self, node: str) -> None:
        """Start the daemon of a node."""
        self.run("/usr/sbin/slurmd", "-f", str(self.configuration), "-N", node, TEST_NODE=node)

    def kill_node(self, node: str) -> int:
        """End a node as a power cut does: its daemon, the steps and all that runs in them; return how many."""
        return self._kill("TEST_NODE", node) + self._kill("SLURMD_NODENAME", node)

    def stop(self) -> None:
        """End every process of the cluster, until none is left."""
        while self._kill("SLURM_CONF", str(self.configuration)):
            pass

    def state(self, node: str) -> str:
        """Return the state of a node, such as idle, alloc or down."""
        return self.run("sinfo", "--noheader", "--partition=main", f"--nodes={node}", "--format=%t").strip()

    def run(self, *words: str, **environment: str) -> str:
        """Run a command of Slurm and return what it prints."""
        done = subprocess.run(
            words, env={**os.environ, "SLURM_CONF": str(self.configuration), **environment}, capture_output=True,
            text=True, check=True, timeout=300,
        )  # fmt: skip
        return done.stdout

    def _kill(self, name: str, value: str) -> int:
        """Kill what has this in its environment, and this cluster's mark, as all that descends from its daemons has."""
        found = []
        for process in psutil.process_iter():
            try:
                environment = process.environ()
                if environment.get("SLURM_CONF") == str(self.configuration) and environment.get(name) == value:
                    process.kill()
                    found.append(process)
            except psutil.Error:  # it has ended meanwhile
                continue
        psutil.wait_procs(found, 10)
        return len(found)


@pytest.fixture
def slurm_cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """A Slurm of two nodes with one core each, which is ended and removed however the test ends."""
    install()
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # a socket's path must be short
    cluster = Cluster(folder, free_ports(3))
    try:
        cluster.start()
        monkeypatch.setenv("SLURM_CONF", str(cluster.configuration))
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder, ignore_errors=True)


def free_ports(count: int) -> int:
    """Return the first of `count` ports in a row that nobody listens on, on the loopback device."""
    for first in range(17002, 18000, count):
        try:
            for port in range(first, first + count):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return first
    raise OSError("no free ports")
