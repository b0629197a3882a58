"""A server on this machine that has one file, and such ways as servers have."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Behaviour:
    """What the server does; changed while it runs."""

    data: bytes
    etag: str | None = '"1"'
    drops: list[int] = field(default_factory=list)  # bytes after which the next connections go
    statuses: list[int] = field(default_factory=list)  # of the next answers, in place of the file
    location: str | None = None  # where the file is, instead
    ranges: bool = True
    length: bool = True  # whether it tells it
    shift: int = 0  # added to the first byte of a range that it says it gives
    more: bytes = b""  # after the end
    asked: list[str | None] = field(default_factory=list)  # the ranges asked for
    url: str = ""


@contextmanager
def serving(data: bytes) -> Iterator[Behaviour]:
    """The server's behaviour, with its address."""
    found = Behaviour(data)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self.close_connection = True
            asked = self.headers.get("Range")
            found.asked.append(asked)
            if found.statuses:
                self.send_error(found.statuses.pop(0))
                return
            if found.location is not None:
                self.send_response(302)
                self.send_header("Location", found.location)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            start = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and found.ranges else 0
            if found.etag is None or self.headers.get("If-Range") != found.etag:
                start = 0
            if start and start >= len(found.data):
                self.send_error(416)
                return
            body = found.data[start:]
            self.send_response(206 if start else 200)
            if start:
                last, size = len(found.data) - 1, len(found.data)
                self.send_header("Content-Range", f"bytes {start + found.shift}-{last}/{size}")
            if found.length:
                self.send_header("Content-Length", str(len(body)))
            if found.etag is not None:
                self.send_header("ETag", found.etag)
            self.end_headers()
            drop = found.drops.pop(0) if found.drops else None
            self.wfile.write((body + found.more)[:drop])

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    found.url = f"http://127.0.0.1:{server.server_address[1]}/scenes.zip"
    try:
        yield found
    finally:
        server.shutdown()
        server.server_close()
