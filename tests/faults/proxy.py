"""A TCP connection that can be cut, stalled and slowed: stands between the learner and who calls it."""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress

from liir_common.rpc.channel import KEEPALIVE_MS

_CHUNK_BYTES = 64 * 1024
_RESET_ON_CLOSE = struct.pack("ii", 1, 0)
"""SO_LINGER on, for no time: the peer gets a reset instead of a goodbye."""
_ESTABLISHED = 1
"""TCP_ESTABLISHED, in the first byte of TCP_INFO: neither side has said goodbye."""
_TRAFFIC_S = 2 * KEEPALIVE_MS / 1000
"""For which a stall waits for something to hold up; a connection at rest has a ping every `KEEPALIVE_MS`."""


class Proxy:
    """Forwards 127.0.0.1:`port` to another port of this machine."""

    def __init__(self, target_port: int) -> None:
        """Listen at once; the target need not be there yet."""
        self.delay_s = 0.0
        """Before every chunk that is forwarded, in each direction."""
        self._target = ("127.0.0.1", target_port)
        self._flowing = threading.Event()
        self._flowing.set()
        self._holding = threading.Event()
        """A chunk waits for the end of a stall."""
        self._slowness_s = 0.0
        """More delay, as a fault."""
        self._slowed = threading.Event()
        """A chunk had that delay."""
        self._connections: set[tuple[socket.socket, socket.socket]] = set()
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        """Where to call instead of the target."""
        return f"127.0.0.1:{self.port}"

    def cut(self) -> bool:
        """Reset every connection; new ones are welcome. False if there was none with both its ends."""
        with self._lock:
            connections, self._connections = self._connections, set()
        found = any(all(map(_established, connection)) for connection in connections)
        for connection in connections:
            for end in connection:
                _reset(end)
        return found

    def stall(self, seconds: float) -> bool:
        """Swallow nothing and forward nothing for a while: neither side hears that anything is wrong.

        False if it is stalled already, or nobody sends anything.
        """
        if not self._flowing.is_set():
            return False
        self._holding.clear()
        self._flowing.clear()
        holds = self._holding.wait(_TRAFFIC_S)
        threading.Timer(seconds if holds else 0.0, self._flowing.set).start()
        return holds

    def slow(self, delay_s: float, seconds: float) -> bool:
        """Delay every chunk by so much more for a while, and return then. False if none came."""
        self._slowed.clear()
        self._slowness_s = delay_s
        time.sleep(seconds)
        self._slowness_s = 0.0
        return self._slowed.is_set()

    def close(self) -> None:
        """Cut everything and listen no more."""
        self._listener.close()
        self._flowing.set()
        self.cut()

    def _accept(self) -> None:
        with suppress(OSError):  # the listener was closed
            while True:
                near, _ = self._listener.accept()
                try:
                    far = socket.create_connection(self._target)
                except OSError:
                    _reset(near)
                    continue
                connection = near, far
                with self._lock:
                    self._connections.add(connection)
                for sink in connection:
                    threading.Thread(target=self._pump, args=(connection, sink), daemon=True).start()

    def _pump(self, connection: tuple[socket.socket, socket.socket], sink: socket.socket) -> None:
        source = connection[0] if sink is connection[1] else connection[1]
        with suppress(OSError):  # either end is gone, or was cut
            while chunk := source.recv(_CHUNK_BYTES):
                self._wait()
                sink.sendall(chunk)
        with self._lock:
            self._connections.discard(connection)
        for end in connection:
            _reset(end)

    def _wait(self) -> None:
        """What a chunk has to wait for."""
        if not self._flowing.is_set():
            self._holding.set()
            self._flowing.wait()
        if slowness_s := self._slowness_s:
            self._slowed.set()
        time.sleep(self.delay_s + slowness_s)


def _established(end: socket.socket) -> bool:
    with suppress(OSError):
        return end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] == _ESTABLISHED
    return False


def _reset(end: socket.socket) -> None:
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        # Wakes a thread that is reading, which closing alone does not. To end writing would be a goodbye.
        end.shutdown(socket.SHUT_RD)
    end.close()
