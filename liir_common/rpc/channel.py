"""How a process reaches the learner: channel options, deadlines and retries in one place."""

import json
import random
from collections.abc import Iterator

import grpc

from liir_common.errors import UnreachableError

MAX_MESSAGE_BYTES = 32 * 2**20
"""Largest message either side takes; a 27m_vs_30m episode has about 7 MiB."""
DEADLINE_S = 10.0
"""Of every unary call."""
KEEPALIVE_MS, KEEPALIVE_TIMEOUT_MS = 5_000, 3_000
"""A peer that answers no ping is given up after at most their sum."""

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
    ("grpc.keepalive_time_ms", KEEPALIVE_MS),
    ("grpc.keepalive_timeout_ms", KEEPALIVE_TIMEOUT_MS),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    ("grpc.service_config", json.dumps(_SERVICE_CONFIG)),
)


def connect(address: str, timeout_s: float = 30.0) -> grpc.Channel:
    """A channel to the learner at HOST:PORT, once it answers.

    Raises:
        UnreachableError: nobody answered within `timeout_s`.
    """
    channel = grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
    try:
        grpc.channel_ready_future(channel).result(timeout=timeout_s)
    except grpc.FutureTimeoutError:
        channel.close()
        raise UnreachableError(
            f"no learner answered at {address} within {timeout_s:g} s; is it running, and is the port the "
            "one in its run directory's endpoints.json?"
        ) from None
    return channel


def backoffs(first_s: float = 0.1, most_s: float = 5.0) -> Iterator[float]:
    """Waiting times that double up to a limit, each shortened by chance so that peers spread out."""
    wait = first_s
    while True:
        yield wait * random.uniform(0.5, 1.0)
        wait = min(2 * wait, most_s)
