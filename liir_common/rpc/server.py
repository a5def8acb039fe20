"""How the learner is served: options, address rules, health, reflection, errors as status codes."""

import ipaddress
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import grpc
import structlog
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2

from liir_common import metrics
from liir_common.config import SecurityConfig
from liir_common.errors import ConfigError
from liir_common.rpc import channel
from liir_common.rpc.gen.liir.v1 import checkpoint_pb2, rollout_pb2, training_pb2
from liir_common.rpc.refused import Refused
from liir_common.rpc.security import AuthInterceptor, server_credentials
from liir_common.rpc.tokens import METHODS, PUBLIC, Tokens

log = structlog.get_logger()

_OPTIONS = (
    ("grpc.max_receive_message_length", channel.MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", channel.MAX_MESSAGE_BYTES),
    *channel.KEEPALIVE_OPTIONS,
    ("grpc.http2.min_ping_interval_without_data_ms", channel.KEEPALIVE_MS // 2),
    ("grpc.http2.max_ping_strikes", 0),
    # Two learners on one port would each get half of the actors.
    ("grpc.so_reuseport", 0),
)
_REFLECTION_V1 = "grpc.reflection.v1.ServerReflection"
_MAX_REASON = 1000
"""Characters of an error message; it may quote what a peer sent."""
_SERVICES = tuple(
    descriptor.full_name
    for module in (rollout_pb2, checkpoint_pb2, training_pb2)
    for descriptor in module.DESCRIPTOR.services_by_name.values()
)


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
        inner = getattr(handler, attribute)
        decode = _decode_stream if handler.request_streaming else _decode
        # gRPC itself would answer bytes that are no message with UNKNOWN and the name of a Python class.
        return make(
            guard(lambda request, context: inner(decode(request, handler), context), details.method),
            response_serializer=handler.response_serializer,
        )


def _decode(request: bytes, handler: Any) -> Any:
    if handler.request_deserializer is None:
        return request
    try:
        return handler.request_deserializer(request)
    except DecodeError:
        raise ValueError(f"wanted a message of this method, got {len(request)} bytes that are none") from None


async def _decode_stream(requests: AsyncIterator[bytes], handler: Any) -> AsyncIterator[Any]:
    async for request in requests:
        yield _decode(request, handler)


def _guard_unary(inner: Callable[..., Awaitable[Any]], method: str) -> Callable[..., Awaitable[Any]]:
    async def guarded(request: Any, context: grpc.aio.ServicerContext) -> Any:
        async with _errors_mapped(context, method):
            return await inner(request, context)

    return guarded


def _guard_stream(inner: Callable[..., AsyncIterator[Any]], method: str) -> Callable[..., AsyncIterator[Any]]:
    async def guarded(request: Any, context: grpc.aio.ServicerContext) -> AsyncIterator[Any]:
        async with _errors_mapped(context, method):
            async for response in inner(request, context):
                yield response

    return guarded


@asynccontextmanager
async def _errors_mapped(context: grpc.aio.ServicerContext, method: str) -> AsyncIterator[None]:
    # The caller chooses both: no label for every name made up, no status beyond what gRPC lets through.
    known = method if method in METHODS or method in PUBLIC else "unknown"
    try:
        yield
    except (Refused, ValueError) as error:
        code = error.code if isinstance(error, Refused) else grpc.StatusCode.INVALID_ARGUMENT
        reason = str(error)[:_MAX_REASON]
        metrics.RPC_ERRORS.labels(method=known, code=code.name).inc()
        log.warning("refused a call", method=known, code=code.name, reason=reason, peer=context.peer())
        await context.abort(code, reason)
    except grpc.aio.AbortError:
        raise  # gRPC's own health service has answered
    except Exception:
        # A mistake of ours: gRPC logs it with its traceback and answers UNKNOWN.
        metrics.RPC_ERRORS.labels(method=known, code=grpc.StatusCode.UNKNOWN.name).inc()
        raise


class Server:
    """A gRPC server with health and reflection; `local_address` is where this machine reaches it."""

    def __init__(self, host: str, port: int, security: SecurityConfig, insecure: bool = False) -> None:
        """Bind at once, so that a busy port is known before anything else starts.

        Raises:
            ConfigError: the port is taken, a file of `security` cannot be used, or other machines can reach
                the address, TLS or tokens are missing, and `insecure` does not say that this is meant.
        """
        credentials, tokens = server_credentials(security), Tokens(security.tokens)
        _check_exposure(host, insecure, tls=credentials is not None, tokens=bool(tokens))
        interceptors = (ErrorInterceptor(), *((AuthInterceptor(tokens),) if tokens else ()))
        self.grpc = grpc.aio.server(interceptors=interceptors, options=_OPTIONS)
        host = _bracketed(host)
        address = f"{host}:{port}"
        try:
            self.port: int = (
                self.grpc.add_secure_port(address, credentials)
                if credentials
                else self.grpc.add_insecure_port(address)
            )
        except RuntimeError:
            raise ConfigError(
                f"cannot listen on {address}: the port is taken or the address is not this machine's; "
                "choose another with --set learner.port=N (0 takes a free one)"
            ) from None
        # Every interface is no address to call; from this machine loopback is, and the certificate's.
        self.local_address = f"{'127.0.0.1' if host == '0.0.0.0' else host}:{self.port}"
        self._health = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self.grpc)
        _serve_reflection(self.grpc)

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


def _serve_reflection(server: grpc.aio.Server) -> None:
    """Version v1alpha, and v1, which newer clients ask for: the same messages under another name."""
    names = (*_SERVICES, health.SERVICE_NAME, reflection.SERVICE_NAME)
    reflection.enable_server_reflection(names, server)
    handler = grpc.stream_stream_rpc_method_handler(
        reflection.aio.ReflectionServicer(names).ServerReflectionInfo,
        reflection_pb2.ServerReflectionRequest.FromString,
        reflection_pb2.ServerReflectionResponse.SerializeToString,
    )
    handlers = {"ServerReflectionInfo": handler}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_REFLECTION_V1, handlers),))


def _check_exposure(host: str, insecure: bool, tls: bool, tokens: bool) -> None:
    if tokens and not tls:
        raise ConfigError("there are tokens, and no security.cert; a token never travels in plaintext")
    if insecure or _is_loopback(host) or (tls and tokens):
        return
    missing = " and ".join(
        what
        for what, there in (("TLS (security.cert)", tls), ("tokens (security.tokens)", tokens))
        if not there
    )
    raise ConfigError(
        f"learner.host is {host}, which other machines can reach, without {missing}; `liir certs` makes both "
        "for development; or keep to 127.0.0.1, or set learner.insecure=true on a network you trust"
    )


def _bracketed(host: str) -> str:
    """IPv6 addresses in brackets, or gRPC takes their last part for the port."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
