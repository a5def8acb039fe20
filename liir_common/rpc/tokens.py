"""Bearer tokens: the file that holds them, who a token makes you, and what each role may call.

A line of the file is `ROLE TOKEN [EXPIRES]`, EXPIRES an ISO 8601 date or time (UTC unless it says otherwise);
`#` begins a comment. The learner accepts every line; a client uses the line of its role, or its only
one.
"""

from __future__ import annotations

import hmac
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import grpc
import structlog

from liir_common.errors import ConfigError
from liir_common.rpc.refused import Refused

log = structlog.get_logger()

VARIABLE = "LIIR_TOKENS"
"""Environment variable with the same lines, read when no file is named."""
_FORM = re.compile(r"[A-Za-z0-9._~+/=-]{32,}")


class Role(StrEnum):
    """Who calls."""

    ACTOR = "actor"
    EVALUATOR = "evaluator"
    READER = "reader"
    OPERATOR = "operator"


_EVERY_ROLE = frozenset(Role)
_READ = frozenset({Role.EVALUATOR, Role.READER, Role.OPERATOR})
METHODS: Mapping[str, frozenset[Role]] = {
    "/liir.v1.RolloutService/Play": frozenset({Role.ACTOR, Role.OPERATOR}),
    "/liir.v1.CheckpointService/ListCheckpoints": _READ,
    "/liir.v1.CheckpointService/GetCheckpoint": _READ,
    "/liir.v1.CheckpointService/WatchCheckpoints": _READ,
    "/liir.v1.CheckpointService/ListEvaluations": _READ,
    "/liir.v1.CheckpointService/ReportEvaluation": frozenset({Role.EVALUATOR, Role.OPERATOR}),
    # What to play: actors and evaluators cannot begin without it.
    "/liir.v1.TrainingService/GetRun": _EVERY_ROLE,
    "/liir.v1.TrainingService/GetStatus": frozenset({Role.READER, Role.OPERATOR}),
    "/liir.v1.TrainingService/Stop": frozenset({Role.OPERATOR}),
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": _EVERY_ROLE,
    "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo": _EVERY_ROLE,
}
"""Roles that may call a method; what is not listed, here or in PUBLIC, nobody may call."""
PUBLIC = frozenset(f"/grpc.health.v1.Health/{method}" for method in ("Check", "List", "Watch"))
"""Methods that need no token: probes have none, and the answer is only that the server serves."""


@dataclass(frozen=True)
class Token:
    """One line of the file; the secret never shows in a log."""

    role: Role
    secret: str = field(repr=False)
    expires: datetime | None

    @property
    def expired(self) -> bool:
        """Whether its time is over."""
        return self.expires is not None and datetime.now(UTC) >= self.expires


class Tokens:
    """The tokens of a file or of the environment; a changed file is read again when it is next needed."""

    def __init__(self, path: str) -> None:
        """Read the file at `path`, or the environment if it is empty.

        Raises:
            ConfigError: the file cannot be read, or a line has another form.
        """
        self._path = path
        self._stamp: tuple[int, int] | None = None
        self._tokens: tuple[Token, ...] = ()
        if path:
            self._read()
        else:
            self._tokens = parse(os.environ.get(VARIABLE, ""), VARIABLE)

    def __bool__(self) -> bool:
        return bool(self._tokens)

    def own(self, role: Role) -> Token:
        """The token to call with: one of the role if there is one, not expired if there is one."""
        return min(self._current(), key=lambda token: (token.role is not role, token.expired))

    def authorize(self, method: str, metadata: Mapping[str, str | bytes]) -> None:
        """Return if a call with this metadata may be served.

        Raises:
            Refused: UNAUTHENTICATED if the token is missing, unknown or expired; PERMISSION_DENIED if its
                role may not call the method.
        """
        if method in PUBLIC:
            return
        token = self._find(str(metadata.get("authorization", "")))
        allowed = METHODS.get(method, frozenset())
        if token.role not in allowed:
            who = f"it takes {' or '.join(sorted(allowed))}" if allowed else "nobody may"
            raise Refused(
                grpc.StatusCode.PERMISSION_DENIED, f"a token of role {token.role} may not call this; {who}"
            )

    def _find(self, header: str) -> Token:
        scheme, _, secret = header.partition(" ")
        if scheme.lower() != "bearer" or not secret:
            raise _unauthenticated(
                "wanted a token as metadata `authorization: Bearer …`, got none; name a file with one in "
                f"security.tokens, or set {VARIABLE}"
            )
        found = None
        # All are compared, each in constant time: how long it takes tells nothing of what they hold.
        for token in self._current():
            if hmac.compare_digest(token.secret.encode(), secret.encode()):
                found = token
        if found is None:
            raise _unauthenticated("this learner does not know the token; ask its operator for another")
        if found.expired:
            raise _unauthenticated(
                f"the token, of role {found.role}, expired at {found.expires:%Y-%m-%d %H:%M} UTC; "
                "ask the learner's operator for another"
            )
        return found

    def _current(self) -> tuple[Token, ...]:
        if self._path:
            try:
                self._read()
            except ConfigError as error:
                log.error("the tokens file cannot be used; what it last said still holds", reason=str(error))
        return self._tokens

    def _read(self) -> None:
        path = Path(self._path)
        try:
            status = path.stat()
            stamp = (status.st_mtime_ns, status.st_ino)
            if stamp == self._stamp:
                return
            text = path.read_text(encoding="ascii")
        except OSError as error:
            raise ConfigError(f"cannot read security.tokens, {path}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"security.tokens, {path}: wanted ASCII text, got other bytes") from None
        tokens = parse(text, self._path)
        if not tokens:
            raise ConfigError(f"security.tokens, {path}: wanted lines `ROLE TOKEN [EXPIRES]`, got none")
        self._stamp, self._tokens = stamp, tokens


def parse(text: str, source: str) -> tuple[Token, ...]:
    """Tokens of the lines of `text`; errors name `source` and the line, never what is in it.

    Raises:
        ConfigError: a line has another form.
    """
    tokens = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) not in (2, 3) or words[0] not in set(Role) or not _FORM.fullmatch(words[1]):
            raise ConfigError(
                f"{source}, line {number}: wanted `ROLE TOKEN [EXPIRES]` with a role of {', '.join(Role)} "
                "and a token of at least 32 characters A-Z a-z 0-9 . _ ~ + / = -"
            )
        tokens.append(Token(Role(words[0]), words[1], _parse_time(words[2:], f"{source}, line {number}")))
    return tuple(tokens)


def _parse_time(words: list[str], where: str) -> datetime | None:
    if not words:
        return None
    try:
        time = datetime.fromisoformat(words[0])
    except ValueError:
        raise ConfigError(f"{where}: wanted the expiry as ISO 8601, such as 2027-01-31") from None
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _unauthenticated(message: str) -> Refused:
    return Refused(grpc.StatusCode.UNAUTHENTICATED, message)
