"""TLS and tokens on both ends of a channel, from the files that the section `security` names."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import grpc
import structlog

from liir_common.config import SecurityConfig
from liir_common.errors import ConfigError
from liir_common.rpc.refused import Refused
from liir_common.rpc.tokens import Role, Tokens

log = structlog.get_logger()


def channel_credentials(security: SecurityConfig, role: Role) -> grpc.ChannelCredentials | None:
    """What a client of this role shows and asks for; None for plaintext.

    Raises:
        ConfigError: a file cannot be read, or there are tokens and no CA, so that they would travel openly.
    """
    tokens = Tokens(security.tokens)
    if not security.ca:
        if tokens:
            raise ConfigError("there are tokens, and no security.ca; a token never travels in plaintext")
        return None
    pair = (_pem(security, "key"), _pem(security, "cert")) if security.cert else (None, None)
    tls = grpc.ssl_channel_credentials(_pem(security, "ca"), *pair)
    if not tokens:
        return tls

    return grpc.composite_channel_credentials(
        tls, grpc.metadata_call_credentials(_Authorization(tokens, role))
    )


class _Authorization(grpc.AuthMetadataPlugin):
    """Adds the token to a call, as the file has it by then."""

    def __init__(self, tokens: Tokens, role: Role) -> None:
        self._tokens = tokens
        self._role = role

    def __call__(self, context: grpc.AuthMetadataContext, callback: grpc.AuthMetadataPluginCallback) -> None:
        callback((("authorization", f"Bearer {self._tokens.own(self._role).secret}"),), None)


def server_credentials(security: SecurityConfig) -> grpc.ServerCredentials | None:
    """The server's certificate, read again when its files change; None for plaintext.

    With a client CA, only clients with a certificate of it are let in.

    Raises:
        ConfigError: a file cannot be read.
    """
    if not security.cert:
        return None
    files = CertificateFiles(security)
    return grpc.dynamic_ssl_server_credentials(
        files.read(),
        files.changed,  # type: ignore[arg-type]  # the stub forgets that None means unchanged
        require_client_authentication=bool(security.client_ca),
    )


class CertificateFiles:
    """The server's certificate, key and client CA on disk."""

    def __init__(self, security: SecurityConfig) -> None:
        """Nothing is read yet."""
        self._security = security
        self._contents: tuple[bytes, bytes, bytes | None] | None = None

    def read(self) -> grpc.ServerCertificateConfiguration:
        """What the files hold now.

        Raises:
            ConfigError: a file cannot be read.
        """
        key, cert = _pem(self._security, "key"), _pem(self._security, "cert")
        client_ca = _pem(self._security, "client_ca") if self._security.client_ca else None
        self._contents = (key, cert, client_ca)
        return grpc.ssl_server_certificate_configuration([(key, cert)], client_ca)

    def changed(self) -> grpc.ServerCertificateConfiguration | None:
        """gRPC asks at every handshake; None lets it go on with what it has."""
        before = self._contents
        try:
            configuration = self.read()
        except ConfigError as error:
            log.error("a certificate cannot be read again; the last one stays", reason=str(error))
            return None
        return configuration if self._contents != before else None


def _pem(security: SecurityConfig, name: str) -> bytes:
    path = Path(getattr(security, name))
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read security.{name}, {path}: {error.strerror}") from None
    if b"-----BEGIN " not in data:
        raise ConfigError(f"security.{name}, {path}: wanted a PEM file, got something else")
    return data


class AuthInterceptor(grpc.aio.ServerInterceptor):
    """Lets a call through to its handler only if its token's role may make it."""

    def __init__(self, tokens: Tokens) -> None:
        """Accept these tokens."""
        self._tokens = tokens

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        details: grpc.HandlerCallDetails,
    ) -> Any:
        """The handler, or one that refuses before it reads a byte of the request."""
        try:
            self._tokens.authorize(details.method, dict(details.invocation_metadata))
        except Refused as error:
            return grpc.stream_stream_rpc_method_handler(_refuse(error))
        return await continuation(details)


def _refuse(error: Refused) -> Callable[..., Any]:
    async def refuse(requests: Any, context: Any) -> Any:
        raise error
        yield  # what makes it a stream, as the guard of errors wants

    return refuse
