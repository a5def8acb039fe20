"""The files of `security` on their way to a process on another machine, where they touch no disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from liir_common.config import SecurityConfig
from liir_common.errors import ConfigError
from liir_common.rpc.tokens import VARIABLE, Role, Tokens


def pack(security: SecurityConfig, role: Role | None = None) -> dict[str, bytes]:
    """Contents of the files by key of the section; for a client of `role`, only the token it will send.

    Tokens may be in the environment instead.

    Raises:
        ConfigError: a file cannot be read.
    """
    contents = {name: _read(name, path) for name, path in security.model_dump().items() if path}
    if role is not None and (tokens := Tokens(security.tokens)):
        own = tokens.own(role)
        contents["tokens"] = f"{own.role} {own.secret}\n".encode()
    elif role is None and (text := os.environ.get(VARIABLE)) and not security.tokens:
        contents["tokens"] = text.encode()
    return contents


def unpack(contents: Mapping[str, bytes]) -> SecurityConfig:
    """The section that names the contents as files in memory, which last as long as this process (Linux).

    Other processes of the same user can read them under these names.
    """
    return SecurityConfig(**{name: in_memory(name, data) for name, data in contents.items()})


def in_memory(name: str, data: bytes) -> str:
    """Path of a new file in memory with this content; it is gone with this process."""
    handle = os.memfd_create(name)
    with os.fdopen(os.dup(handle), "wb") as file:
        file.write(data)
    return f"/proc/{os.getpid()}/fd/{handle}"


def _read(name: str, path: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read security.{name}, {path}: {error.strerror}") from None
