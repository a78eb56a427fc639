"""One HTTP connection whose every call ends in time, however its answer drips in."""

import http.client
import math
import select
import socket
import time
from contextlib import nullcontext, suppress
from typing import Any


class _Socket(socket.socket):
    """A socket that reads until a moment, and not for a time after each byte."""

    until_s = math.inf

    def recv_into(self, *args: Any, **options: Any) -> int:
        """Read what comes before the moment is over."""
        self.settimeout(max(self.until_s - time.monotonic(), 1e-6))
        return super().recv_into(*args, **options)


class Connection(http.client.HTTPConnection):
    """A connection that is kept open, and made anew when lost. limit_s: of a whole call."""

    sock: Any

    def __init__(self, address: str, limit_s: float) -> None:
        super().__init__(address, timeout=limit_s)
        self._limit_s = limit_s

    def connect(self) -> None:
        """Connect, with a socket that knows its moment."""
        super().connect()
        self.sock = _Socket(fileno=self.sock.detach())

    def call(
        self, method: str, path: str, content: bytes | None, limit: int, *, whole: bool
    ) -> tuple[int, bytes]:
        """Status and body of an answer; of a body longer than `limit`, one byte more than it.

        Without `whole` the body is read only as far as it comes. Raises OSError (TimeoutError: no
        answer in time), or HTTPException for an answer that is no HTTP or breaks off.
        """
        until_s = time.monotonic() + self._limit_s
        if self.sock is not None and select.select([self.sock], [], [], 0.0)[0]:
            self.close()  # the other side closed it, or said what nobody asked for
        try:
            if self.sock is None:
                self.connect()
            self.sock.until_s = until_s
            self.sock.settimeout(self._limit_s)
            self.request(method, path, content, {"Content-Type": "application/json"})
            reply = self.getresponse()
            body = b""
            with nullcontext() if whole else suppress(OSError, http.client.HTTPException):
                body = reply.read(limit + 1)
            if not reply.isclosed():  # too long, cut off, or still on its way
                self.close()
            if whole and reply.length and len(body) <= limit:
                raise http.client.IncompleteRead(body)
        except BaseException:
            self.close()
            raise
        return reply.status, body
