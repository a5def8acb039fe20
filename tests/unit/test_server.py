"""The server's interceptor: what a handler raises becomes a status code, and is counted once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

import grpc
import pytest

from liir_common import metrics
from liir_common.config import PLAINTEXT
from liir_common.rpc import server
from liir_common.rpc.refused import Refused
from liir_common.rpc.server import Server

SERVICE = "liir.v1.TrainingService"
ERRORS: dict[str, BaseException] = {
    "NOT_FOUND": Refused(grpc.StatusCode.NOT_FOUND, "none"),
    "INVALID_ARGUMENT": ValueError("wanted another"),
    "UNKNOWN": KeyError("a mistake of ours"),
    "CANCELLED": asyncio.CancelledError(),
}


def counted(method: str) -> dict[str, float]:
    """Code → failed calls of a method."""
    (family,) = metrics.RPC_ERRORS.collect()
    return {
        sample.labels["code"]: sample.value
        for sample in family.samples
        if sample.name.endswith("_total") and sample.labels["method"] == method
    }


async def call(name: str, error: BaseException) -> grpc.StatusCode:
    """The code that a call of method `name` ends with if its handler raises `error`."""

    async def one(request: bytes, context: Any) -> bytes:
        raise error

    async def stream(request: bytes, context: Any) -> AsyncIterator[bytes]:
        yield b"first"
        raise error

    handlers = {
        "GetStatus": grpc.unary_unary_rpc_method_handler(one),
        "GetRun": grpc.unary_stream_rpc_method_handler(stream),
    }
    server = Server("127.0.0.1", 0, PLAINTEXT)
    server.grpc.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
    await server.start()
    try:
        async with grpc.aio.insecure_channel(server.local_address) as channel:
            responses = channel.unary_stream(f"/{SERVICE}/{name}")(b"", timeout=10)
            with suppress(grpc.aio.AioRpcError, asyncio.CancelledError):
                async for _ in responses:
                    pass
            return await responses.code()
    finally:
        await server.stop(0)


@pytest.mark.parametrize("name", ["GetStatus", "GetRun"])
@pytest.mark.parametrize("code", ERRORS)
def test_whatever_a_handler_raises_but_cancellation_is_counted(name: str, code: str) -> None:
    before = counted(f"/{SERVICE}/{name}")
    ended = asyncio.run(call(name, ERRORS[code])).name
    after = counted(f"/{SERVICE}/{name}")
    if code == "CANCELLED":
        assert after == before
    else:
        assert (ended, after) == (code, before | {code: before.get(code, 0) + 1})


@pytest.mark.parametrize(
    ("host", "name", "loopback"),
    [
        ("::1", "[::1]", True),
        ("[::1]", "[::1]", True),
        ("127.0.0.1", "127.0.0.1", True),
        ("::", "[::]", False),
    ],
)
def test_addresses_of_ipv6_are_in_brackets(host: str, name: str, loopback: bool) -> None:
    assert server._bracketed(host) == name
    assert server._is_loopback(host) == loopback
