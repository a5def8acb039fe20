"""A TCP connection that can be cut, stalled and slowed: stands between the learner and who calls it."""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress

_CHUNK_BYTES = 64 * 1024
_RESET_ON_CLOSE = struct.pack("ii", 1, 0)
"""SO_LINGER on, for no time: the peer gets a reset instead of a goodbye."""


class Proxy:
    """Forwards 127.0.0.1:`port` to another port of this machine."""

    def __init__(self, target_port: int) -> None:
        """Listen at once; the target need not be there yet."""
        self.delay_s = 0.0
        """Before every chunk that is forwarded, in each direction."""
        self._target = ("127.0.0.1", target_port)
        self._flowing = threading.Event()
        self._flowing.set()
        self._sockets: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        """Where to call instead of the target."""
        return f"127.0.0.1:{self.port}"

    def cut(self) -> None:
        """Reset every connection; new ones are welcome."""
        with self._lock:
            sockets, self._sockets = self._sockets, set()
        for end in sockets:
            _reset(end)

    def stall(self, seconds: float) -> None:
        """Swallow nothing and forward nothing for a while: neither side hears that anything is wrong."""
        self._flowing.clear()
        threading.Timer(seconds, self._flowing.set).start()

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
                with self._lock:
                    self._sockets |= {near, far}
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):  # either end is gone, or was cut
            while chunk := source.recv(_CHUNK_BYTES):
                self._flowing.wait()
                time.sleep(self.delay_s)
                sink.sendall(chunk)
        with self._lock:
            self._sockets -= {source, sink}
        for end in (source, sink):
            _reset(end)


def _reset(end: socket.socket) -> None:
    with suppress(OSError):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        # Wakes a thread that is reading, which closing alone does not.
        end.shutdown(socket.SHUT_RDWR)
    end.close()
