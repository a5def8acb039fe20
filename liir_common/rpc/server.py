"""How the learner is served: options, address rules, health, reflection, errors as status codes."""

import ipaddress
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
import structlog
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from liir_common import metrics
from liir_common.errors import ConfigError
from liir_common.rpc import channel
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, rollout_pb2, training_pb2

log = structlog.get_logger()

_OPTIONS = (
    ("grpc.max_receive_message_length", channel.MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", channel.MAX_MESSAGE_BYTES),
    ("grpc.keepalive_time_ms", channel.KEEPALIVE_MS),
    ("grpc.keepalive_timeout_ms", channel.KEEPALIVE_TIMEOUT_MS),
    ("grpc.http2.min_ping_interval_without_data_ms", channel.KEEPALIVE_MS // 2),
    ("grpc.http2.max_ping_strikes", 0),
    # Two learners on one port would each get half of the actors.
    ("grpc.so_reuseport", 0),
)
_SERVICES = tuple(
    descriptor.full_name
    for module in (rollout_pb2, checkpoint_pb2, training_pb2)
    for descriptor in module.DESCRIPTOR.services_by_name.values()
)


class Refused(Exception):
    """A request that cannot be served; ends the call with `code` and the message."""

    def __init__(self, code: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.code = code


class ErrorInterceptor(grpc.aio.ServerInterceptor):
    """Maps exceptions of handlers to status codes: the only place that does."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        details: grpc.HandlerCallDetails,
    ) -> Any:
        """Wrap the handler of whatever kind it is."""
        handler = await continuation(details)
        if handler is None:
            return None
        kinds: dict[tuple[bool, bool], tuple[str, Any, Any]] = {
            (False, False): ("unary_unary", grpc.unary_unary_rpc_method_handler, _guard_unary),
            (False, True): ("unary_stream", grpc.unary_stream_rpc_method_handler, _guard_stream),
            (True, False): ("stream_unary", grpc.stream_unary_rpc_method_handler, _guard_unary),
            (True, True): ("stream_stream", grpc.stream_stream_rpc_method_handler, _guard_stream),
        }
        attribute, make, guard = kinds[handler.request_streaming, handler.response_streaming]
        return make(
            guard(getattr(handler, attribute), details.method),
            request_deserializer=handler.request_deserializer,
            response_serializer=handler.response_serializer,
        )


def _guard_unary(inner: Callable[..., Awaitable[Any]], method: str) -> Callable[..., Awaitable[Any]]:
    async def guarded(request: Any, context: grpc.aio.ServicerContext) -> Any:
        try:
            return await inner(request, context)
        except (Refused, ValueError) as error:
            await _abort(context, error, method)

    return guarded


def _guard_stream(inner: Callable[..., AsyncIterator[Any]], method: str) -> Callable[..., AsyncIterator[Any]]:
    async def guarded(request: Any, context: grpc.aio.ServicerContext) -> AsyncIterator[Any]:
        try:
            async for response in inner(request, context):
                yield response
        except (Refused, ValueError) as error:
            await _abort(context, error, method)

    return guarded


async def _abort(context: grpc.aio.ServicerContext, error: Exception, method: str) -> None:
    code = error.code if isinstance(error, Refused) else grpc.StatusCode.INVALID_ARGUMENT
    metrics.RPC_ERRORS.labels(method=method, code=code.name).inc()
    log.warning("refused a call", method=method, code=code.name, reason=str(error), peer=context.peer())
    await context.abort(code, str(error))


class Server:
    """A gRPC server with health and reflection; `port` is the bound one."""

    def __init__(self, host: str, port: int, insecure: bool) -> None:
        """Bind at once, so that a busy port is known before anything else starts.

        Raises:
            ConfigError: the port is taken, or the address is not loopback and plaintext was not asked for.
        """
        if not insecure and not _is_loopback(host):
            raise ConfigError(
                f"learner.host is {host}, which other machines can reach, and this server speaks plaintext; "
                "keep it on 127.0.0.1, or set learner.insecure=true on a network you trust"
            )
        self.grpc = grpc.aio.server(interceptors=(ErrorInterceptor(),), options=_OPTIONS)
        try:
            self.port: int = self.grpc.add_insecure_port(f"{host}:{port}")
        except RuntimeError:
            raise ConfigError(
                f"cannot listen on {host}:{port}: the port is taken or the address is not this machine's; "
                "choose another with --set learner.port=N (0 takes a free one)"
            ) from None
        self._health = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self.grpc)
        names = (*_SERVICES, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self.grpc)

    async def start(self) -> None:
        """Serve, and say so to whoever asks for health."""
        await self.grpc.start()
        for name in ("", *_SERVICES):
            await self._health.set(name, health_pb2.HealthCheckResponse.SERVING)

    async def not_serving(self) -> None:
        """Tell whoever asks for health that this server is leaving."""
        await self._health.enter_graceful_shutdown()

    async def stop(self, grace_s: float) -> None:
        """End; streams still open after the grace are cut."""
        await self.grpc.stop(grace_s)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
