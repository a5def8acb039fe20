"""Machines without a hypervisor: each has its own disk (an overlay of this one's), processes and network.

The first is the user's; its network is the switch that the others are plugged into. Needs root.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

NETWORK = "10.77.0"
# Where it really lies: a link to it may be in /tmp, of which each machine has its own.
VENV = Path(sys.prefix).resolve()
# A shell as first process takes in the orphans, as an init does.
BOOT = """
set -e
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/changes,workdir=$1/work" "$1/root"
cd "$1/root"
mount -t proc proc proc
mount --rbind /dev dev
mount --rbind /sys sys
mount -t tmpfs tmpfs dev/shm
mount -t tmpfs tmpfs tmp
mkdir -p run/sshd
exec chroot . sh -c 'cd; '"$2"'; while true; do sleep 0.5; done'
"""
ENVIRONMENT = {
    "HOME": str(Path.home()),
    "USER": "root",
    "PATH": f"{VENV}/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
    "RAY_AUTH_MODE": "token",
    "RAY_USAGE_STATS_ENABLED": "0",
}
SSHD = "/usr/sbin/sshd -o PermitRootLogin=yes -o PasswordAuthentication=no -o UsePAM=no -o MaxStartups=100"


class Machine:
    """One machine, on or off; `disk` has what it has written there, `home` is its root's home in it."""

    def __init__(self, folder: Path, number: int) -> None:
        """A machine that is off, with the files of this one on its disk."""
        self.address = f"{NETWORK}.{number}"
        self.disk = folder / "changes"
        self.home = self.disk / Path.home().relative_to("/")
        self._folder = folder
        for name in ("changes", "work", "root"):
            (folder / name).mkdir(parents=True)
        self.home.mkdir(parents=True)
        self._name = f"liir{number}"
        self._process: subprocess.Popen[bytes] | None = None

    def boot(self, services: str, switch: Machine | None) -> None:
        """Start it and, unless it is the switch itself, plug it in."""
        kinds = ["--mount", "--pid", "--net", "--ipc", "--uts", "--propagation=private"]
        boot = ["sh", "-c", BOOT, "boot", str(self._folder), services]
        # However this process ends, the machines end with it.
        unshare = ["setpriv", "--pdeathsig", "KILL", "unshare", *kinds, "--fork", "--kill-child"]
        self._process = subprocess.Popen([*unshare, *boot])
        while not self._on_own_disk():
            assert self._process.poll() is None, "the machine does not start"
            time.sleep(0.01)
        if switch is None:
            self._ip("link add bridge0 type bridge")
            device = "bridge0"
        else:
            device = "eth0"
            switch._ip(f"link add {self._name} type veth peer name {device} netns {self._process.pid}")
            switch._ip(f"link set {self._name} master bridge0 up")
        self._ip(f"address add {self.address}/24 dev {device}")
        self._ip(f"link set {device} up")
        self._ip("link set lo up")
        if switch is not None:  # leads nowhere, but Ray takes the address that it would leave by
            self._ip(f"route add default via {switch.address}")

    def lose(self) -> None:
        """Pull the plug: every process is gone at once; the disk stays."""
        if self._process is not None:
            (first,) = self._first_process()
            first.send_signal(signal.SIGKILL)
            self._process.wait(30)
            self._process = None

    def start(self, command: str, output: Path) -> subprocess.Popen[bytes]:
        """Start a shell's command in root's home; stdout and stderr go to the file."""
        (first,) = self._first_process()
        namespaces = ["--mount", "--pid", "--net", "--ipc", "--uts", "--root", "--wd"]
        enter = ["nsenter", "--target", str(first.pid), *namespaces]
        with output.open("wb") as file:
            return subprocess.Popen(
                [*enter, "bash", "-c", f"cd; {command}"],
                env=ENVIRONMENT,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
            )

    def run(self, command: str, timeout_s: float = 240.0) -> str:
        """Run it to its end; returns its output."""
        with tempfile.NamedTemporaryFile() as file:
            process = self.start(command, Path(file.name))
            code = process.wait(timeout_s)
            output = Path(file.name).read_text(errors="replace")
        assert code == 0, f"{command}: code {code}\n{output}"
        return output

    def _on_own_disk(self) -> bool:
        """Whether its first process has left the disk of this machine."""
        roots = [Path(f"/proc/{first.pid}/root").readlink() for first in self._first_process()]
        return roots == [self._folder / "root"]

    def _first_process(self) -> list[psutil.Process]:
        assert self._process is not None
        return psutil.Process(self._process.pid).children()

    def _ip(self, arguments: str) -> None:
        assert self._process is not None
        command = ["nsenter", "--target", str(self._process.pid), "--net", "ip", *arguments.split()]
        subprocess.run(command, check=True)
