"""A process of the run on some node of a Ray cluster: a Ray actor holds it there, the launcher holds that."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import ray
import structlog

from liir_common.files import write_atomic
from liir_common.launch import END_S, LocalService, Service, as_settings
from liir_common.rpc import carry
from services.actor.driver import GONE

log = structlog.get_logger()

_ANSWER_S = END_S + 10.0
_AWAY = (*GONE, ray.exceptions.GetTimeoutError)
_LOST = -signal.SIGKILL
"""Exit code of a process whose node is lost."""
_TOLD = 4096
"""Characters of the end of its log that are known here when its node is lost."""


class Host:
    """Runs a process on its node, which ends when this Ray actor does."""

    def __init__(self, name: str, run_dir: Path) -> None:
        """Nothing runs yet."""
        self._name = name
        self._run_dir = run_dir
        self._service: Service | None = None

    def node(self) -> tuple[str, str]:
        """Address and Ray's id of the node."""
        return ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id()

    def start(self, arguments: Sequence[str], config: bytes, files: Mapping[str, bytes]) -> None:
        """Start the process with this configuration file, if it is one, and these files of `security`."""
        source = ["--config", carry.in_memory("config.yaml", config)] if config else []
        security = as_settings(carry.unpack(files))
        self._service = LocalService(self._name, [*arguments, *source, *security], self._run_dir)
        self._service.start()

    def news(self) -> tuple[int | None, str]:
        """Its exit code, None while it runs, and the end of its log."""
        return self._running().exit_code, self._running().last_words()[-_TOLD:]

    def address(self) -> str | None:
        """Where it serves, once it does."""
        return self._running().address()

    def last_words(self) -> str:
        """The end of its log."""
        return self._running().last_words()

    def end(self) -> None:
        """Ask it to end, and insist after a while."""
        self._running().end()

    def files(self, pattern: str) -> Iterator[tuple[str, bytes]]:
        """Name and content of each file of the run directory that fits, but not of what is being written."""
        for path in sorted(self._run_dir.glob(pattern)):
            if path.is_file() and not path.name.startswith("."):
                try:
                    content = path.read_bytes()
                except FileNotFoundError:  # the learner has deleted it meanwhile
                    continue
                yield str(path.relative_to(self._run_dir)), content

    def _running(self) -> Service:
        assert self._service is not None
        return self._service


class RemoteService(Service):
    """A process on a node that Ray chooses."""

    brought = "logs/*.log"
    """What of its run directory is brought here when it has ended."""

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        run_dir: Path,
        options: Mapping[str, Any],
        config: bytes = b"",
    ) -> None:
        """Prepare to run it in `run_dir`, an absolute path there and here; `options` are of the Ray actor."""
        super().__init__(name, arguments, run_dir)
        self.files: Mapping[str, bytes] = {}
        self._options = dict(options)
        self._config = config
        self._host: Any = None
        self._asked: Any = None
        """Reference that resolves to the news of it, or to None once it is started."""
        self._code: int | None = None
        self._words = ""
        """The end of its log when it was last heard of, and why no more is known if its node is lost."""

    def settle(self) -> str:
        """Have a node chosen, and stay with it whatever happens, since the run is on its disk; its address.

        Waits for as long as no node has what the options ask for.
        """
        self._host = self._new_host()
        address, _ = ray.get(self._host.node.remote())
        self._options["resources"] = {f"node:{address}": 0.001}
        return str(address)

    def start(self) -> None:
        """Start it; after its node was lost, as soon as there is a node for it."""
        self._host = self._host or self._new_host()
        self._code, self._words, self.silent_phase = None, "", "starting"
        self._asked = self._host.start.remote(self.arguments, self._config, self.files)

    @property
    def exit_code(self) -> int | None:
        """None while it runs, or waits for a node."""
        if self._code is None and self._asked is not None and ray.wait([self._asked], timeout=0)[0]:
            self._code = self._answer()
        return self._code

    def address(self) -> str | None:
        """Where it serves, once it does."""
        try:
            address: str | None = ray.get(self._host.address.remote())
        except GONE:  # of which `exit_code` tells
            return None
        return address

    def last_words(self) -> str:
        """The end of its log; of one whose node does not answer, as far as it is known here."""
        if self._host is None:
            return self._words
        try:
            return str(ray.get(self._host.last_words.remote(), timeout=_ANSWER_S))
        except _AWAY as error:
            return self._known("its node does not answer", error)

    def end(self) -> None:
        """Ask it to end, insist after a while, and bring here what it leaves."""
        if self._host is None or self._asked is None:
            return
        try:
            ray.get(self._host.end.remote(), timeout=_ANSWER_S)
            self.fetch(self.brought)
        except (ray.exceptions.RayError, OSError) as error:
            log.warning("its files stay on its node", service=self.name, reason=str(error))
        ray.kill(self._host)

    def fetch(self, pattern: str) -> None:
        """Copy the files of its run directory that fit to the same place here."""
        if ray.get(self._host.node.remote())[1] == ray.get_runtime_context().get_node_id():
            return
        for reference in self._host.files.remote(pattern):
            name, content = ray.get(reference)
            (self.run_dir / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomic(self.run_dir / name, content)

    def _new_host(self) -> Any:
        return ray.remote(Host).options(**self._options).remote(self.name, self.run_dir)

    def _answer(self) -> int | None:
        try:
            news: tuple[int | None, str] | None = ray.get(self._asked)
        except GONE as error:
            log.error("the node of a process is lost", service=self.name, reason=str(error))
            self._words = self._known("its node is lost", error)
            self._host = None
            return _LOST
        code, self._words = news or (None, "")
        if code is None:
            self._asked = self._host.news.remote()
        return code

    def _known(self, what: str, error: Exception) -> str:
        """The last words that came, and why there are no more in one line, which an obituary wants."""
        self.silent_phase = "unknown"  # what came may be cut short
        return f"{self._words.rstrip()}\nerror: {what}: {' '.join(str(error).split())}\n".lstrip()
