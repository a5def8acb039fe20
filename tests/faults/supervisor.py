"""The whole service as processes that are started again when they fail, as a container supervisor does it."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil

from tests.e2e import service

_POLL_S = 0.2
_BIN = Path(sys.executable).parent


def alive(process: psutil.Process) -> bool:
    """Whether there is anything of it left to kill or to stop: not of a zombie.

    Raises:
        psutil.NoSuchProcess: it is gone altogether.
    """
    return process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)


def kill(process: psutil.Process) -> bool:
    """SIGKILL; false, and nothing is done, if it is dead already."""
    with suppress(psutil.NoSuchProcess):
        if alive(process):
            process.kill()
            return True
    return False


class Clock:
    """The wall clock of a process, which can be set."""

    def __init__(self, folder: Path, name: str) -> None:
        """Build the library that reads it, once for a folder, and let the clock go right."""
        self._library = folder / "clock.so"
        self._offset = folder / f"{name}.offset"
        self.set(0)
        if not self._library.exists():
            source = Path(__file__).with_name("clock.c")
            command = ["cc", "-O2", "-shared", "-fPIC", "-o", str(self._library), str(source), "-ldl"]
            subprocess.run(command, check=True)

    def set(self, seconds: float) -> None:
        """Let the clock be wrong by so many seconds from now on."""
        with self._offset.open("r+b" if self._offset.exists() else "wb") as file:
            file.write(struct.pack("q", round(seconds * 1e9)))

    def rules(self, process: psutil.Process) -> bool:
        """Whether the process reads this clock at the moment.

        Raises:
            psutil.NoSuchProcess: it is dead.
        """
        return any(found.path == str(self._offset) for found in process.memory_maps())

    @property
    def environment(self) -> dict[str, str]:
        """What a process must be started with to go by this clock."""
        return {"LD_PRELOAD": str(self._library), "CLOCK_OFFSET_FILE": str(self._offset)}


class Supervised:
    """One process of the service, whatever its incarnation."""

    def __init__(
        self, name: str, command: Sequence[str], folder: Path, environment: Mapping[str, str]
    ) -> None:
        """Start it; its output goes to `log`."""
        self.log = folder / f"{name}.log"
        self.codes: list[int] = []
        """How each incarnation ended."""
        self._command = [str(_BIN / command[0]), *command[1:]]
        self._environment = {**os.environ, **environment}
        self.start()

    def start(self) -> None:
        """Start a new incarnation."""
        with self.log.open("ab") as file:
            self.process = subprocess.Popen(
                self._command, stdout=file, stderr=file, env=self._environment, start_new_session=True
            )

    def tree(self) -> list[psutil.Process]:
        """The process and all that it started."""
        with suppress(psutil.NoSuchProcess):
            root = psutil.Process(self.process.pid)
            return [root, *root.children(recursive=True)]
        return []

    def kill(self) -> None:
        """Kill the process and all that it started: the machine is lost."""
        for process in self.tree():
            kill(process)


class Supervisor:
    """Starts again what fails."""

    def __init__(self) -> None:
        """Nothing to watch yet."""
        self.services: dict[str, Supervised] = {}
        self._watching = True
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def add(
        self, name: str, *command: str, folder: Path, environment: Mapping[str, str] | None = None
    ) -> None:
        """Start a service and watch it from now on."""
        self.services[name] = Supervised(name, command, folder, environment or {})

    def end(self) -> None:
        """End everything, and whatever it started."""
        self._watching = False
        self._thread.join()
        processes = [process for supervised in self.services.values() for process in supervised.tree()]
        for supervised in self.services.values():
            supervised.process.terminate()
        _, left = psutil.wait_procs(processes, timeout=15)
        for process in left:
            kill(process)

    def _watch(self) -> None:
        while self._watching:
            for supervised in list(self.services.values()):
                # Code 0 is the end of the run, or was asked for.
                if supervised.process.poll():
                    supervised.codes.append(supervised.process.returncode)
                    supervised.start()
            time.sleep(_POLL_S)


def add_ray(supervisor: Supervisor, folder: Path, temporary: Path, nodes: int) -> str:
    """A Ray cluster: a head without CPUs and `nodes` nodes with one each; returns its address."""
    address = f"127.0.0.1:{service.free_port()}"
    common = (
        "--object-store-memory=80000000",
        "--node-ip-address=127.0.0.1",
        "--block",
        "--disable-usage-stats",
    )
    # Ray keeps notes of its own nodes there, and its sockets, whose paths must be short.
    places = {"RAY_TMPDIR": str(temporary), "RAY_AUTH_MODE": os.environ.get("RAY_AUTH_MODE", "disabled")}
    # By that note Ray takes nodes of a head that died for a cluster, and would not start another head here.
    forget = ("/bin/sh", "-c", f'rm -f {temporary}/ray_current_cluster; exec "$0" "$@"')
    head = (str(_BIN / "ray"), "start", "--head", f"--port={address.rpartition(':')[2]}", "--num-cpus=0")
    supervisor.add(
        "head",
        *forget,
        *head,
        "--include-dashboard=false",
        f"--temp-dir={temporary}",
        *common,
        folder=folder,
        environment=places,
    )
    for number in range(nodes):
        node = ("ray", "start", f"--address={address}", "--num-cpus=1", *common)
        supervisor.add(f"node-{number}", *node, folder=folder, environment=places)
    return address
