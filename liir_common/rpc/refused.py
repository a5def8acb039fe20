"""How a handler or an interceptor says no."""

import grpc


class Refused(Exception):
    """A request that cannot be served; ends the call with `code` and the message."""

    def __init__(self, code: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.code = code
