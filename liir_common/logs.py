"""Logs: coloured lines on a terminal, one JSON object a line elsewhere."""

import logging
import sys

import structlog
from structlog.tracebacks import ExceptionDictTransformer

from liir_common.errors import say


class _StderrLogger:
    """Hands every line, whatever its level, to `say`: a log that cannot be written ends no process."""

    def __init__(self, *_: object) -> None:
        """Nothing to open."""

    msg = debug = info = warning = error = critical = exception = staticmethod(say)


def configure(process: str) -> None:
    """Set up logging of this process to stderr; every line names the process."""
    terminal = sys.stderr.isatty()
    renderer = structlog.dev.ConsoleRenderer() if terminal else structlog.processors.JSONRenderer()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            # Without local variables: one of them may be a secret.
            structlog.processors.ExceptionRenderer(ExceptionDictTransformer(show_locals=False))
            if not terminal
            else structlog.processors.ExceptionPrettyPrinter(),
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=_StderrLogger,
    )
    structlog.contextvars.bind_contextvars(process=process)
