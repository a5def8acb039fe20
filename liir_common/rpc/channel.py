"""How a process reaches the learner: channel options, deadlines and retries in one place."""

import json
import random
from collections.abc import Iterator
from typing import Any

import grpc

from liir_common.config import PLAINTEXT, SecurityConfig
from liir_common.errors import UnreachableError
from liir_common.rpc.security import channel_credentials
from liir_common.rpc.tokens import Role

MAX_MESSAGE_BYTES = 32 * 2**20
"""Largest message either side takes; a 27m_vs_30m episode has about 7 MiB."""
DEADLINE_S = 10.0
"""Of every unary call."""
AWAY = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.CANCELLED)
"""Codes that tell of the connection, not of the call: to try again may help. No client here cancels a call:
gRPC does so for a learner that did not get to it within half a minute."""
KEEPALIVE_MS, KEEPALIVE_TIMEOUT_MS = 5_000, 7_000
"""A peer that answers no ping is given up after at most their sum."""
KEEPALIVE_OPTIONS = (
    ("grpc.keepalive_time_ms", KEEPALIVE_MS),
    ("grpc.keepalive_timeout_ms", KEEPALIVE_TIMEOUT_MS),
    # What gRPC really waits for the answer to a ping; a minute unless told so, whatever is above.
    ("grpc.http2.ping_timeout_ms", KEEPALIVE_TIMEOUT_MS),
)

# Only UNAVAILABLE is retried, the call may not have arrived, and only for unary calls: who reads a stream
# knows from where to go on. gRPC adds the jitter.
_RETRIED = {
    "CheckpointService": ("ListCheckpoints", "ReportEvaluation", "ListEvaluations"),
    "TrainingService": ("GetRun", "GetStatus", "Stop"),
}
_SERVICE_CONFIG = {
    "methodConfig": [
        {
            "name": [
                {"service": f"liir.v1.{service}", "method": method}
                for service, methods in _RETRIED.items()
                for method in methods
            ],
            "retryPolicy": {
                "maxAttempts": 5,
                "initialBackoff": "0.1s",
                "maxBackoff": "2s",
                "backoffMultiplier": 2,
                "retryableStatusCodes": ["UNAVAILABLE"],
            },
        }
    ]
}
CHANNEL_OPTIONS = (
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    *KEEPALIVE_OPTIONS,
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    ("grpc.service_config", json.dumps(_SERVICE_CONFIG)),
)


def open_channel(address: str, security: SecurityConfig, role: Role) -> grpc.Channel:
    """A channel to the learner at HOST:PORT, answered or not, for calls in this role.

    Raises:
        ConfigError: a file of `security` cannot be used.
    """
    credentials = channel_credentials(security, role)
    if credentials is None:
        return grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
    return grpc.secure_channel(address, credentials, options=CHANNEL_OPTIONS)


def connect(
    address: str,
    timeout_s: float = 30.0,
    security: SecurityConfig = PLAINTEXT,
    role: Role = Role.READER,
) -> grpc.Channel:
    """A channel to the learner at HOST:PORT, once it answers.

    Raises:
        ConfigError: a file of `security` cannot be used.
        UnreachableError: nobody answered within `timeout_s`, or not with TLS as `security` has it.
    """
    channel = open_channel(address, security, role)
    try:
        grpc.channel_ready_future(channel).result(timeout=timeout_s)
    except grpc.FutureTimeoutError:
        with channel:
            reason = _why_not_ready(channel)
        raise UnreachableError(
            f"no learner answered at {address} within {timeout_s:g} s ({reason}); is it running, is the port "
            "the one in its run directory's endpoints.json, and does security.ca here go with security.cert "
            "there?"
        ) from None
    return channel


def _why_not_ready(channel: grpc.Channel) -> str:
    """What gRPC says about the connection; its state alone does not tell a closed port from a wrong CA."""
    try:
        check: Any = channel.unary_unary("/grpc.health.v1.Health/Check")
        check(b"", timeout=1.0)
    except grpc.RpcError as error:
        return str(error.details())
    return "it answered too late"


def backoffs(first_s: float = 0.1, most_s: float = 5.0) -> Iterator[float]:
    """Waiting times that double up to a limit, each shortened by chance so that peers spread out."""
    wait = first_s
    while True:
        yield wait * random.uniform(0.5, 1.0)
        wait = min(2 * wait, most_s)
