"""Messages between the learner and its process that computes: JSON and named arrays, never objects."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from liir_common.types import Array

NO_ARRAYS: Mapping[str, Array] = MappingProxyType({})
_SIZES = struct.Struct("<QQ")


class Link:
    """One end of a pair of sockets; one thread at a time may use it."""

    def __init__(self, end: socket.socket) -> None:
        """Own `end`."""
        self._socket = end
        self._file = end.makefile("rb")

    def close(self) -> None:
        """Tell the other end that this one is gone, and a thread that waits in `receive` here."""
        with suppress(OSError):  # the other end is gone already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._file.close()
        self._socket.close()

    def send(self, head: Any, arrays: Mapping[str, Array] = NO_ARRAYS) -> None:
        """Send what JSON can say, and arrays.

        Raises:
            OSError: the other end is gone.
        """
        text = json.dumps(head).encode()
        # safetensors reads the memory as if every array were in one piece.
        body = save({name: np.asarray(array, order="C") for name, array in arrays.items()})
        self._socket.sendall(_SIZES.pack(len(text), len(body)) + text)
        self._socket.sendall(body)

    def receive(self) -> tuple[Any, dict[str, Array]]:
        """Wait for the next message; its arrays come in no particular order.

        Raises:
            EOFError: the other end is gone.
            OSError: so is it, and it left something unread.
        """
        text, body = _SIZES.unpack(self._read(_SIZES.size))
        return json.loads(self._read(text)), load(self._read(body))

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise EOFError
        return data
