"""Serves the page over HTTP, by default on this machine only."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote, unquote, urlsplit

from keyss.core.errors import OutputError
from keyss.viewer.look import Look
from keyss.viewer.page import SCRIPT, STYLE, asset, readable, served_page, served_policy

LOCALHOST = "127.0.0.1"
_LOCAL_NAMES = {"127.0.0.1", "localhost", "::1"}
# By path: the media type, and a function that opens the content or raises OSError.
Contents = Mapping[str, tuple[str, Callable[[], BinaryIO]]]


class _ServerIPv6(ThreadingHTTPServer):
    address_family = socket.AF_INET6


class PageServer:
    """Serves the page and `contents`, and nothing else."""

    def __init__(
        self, page: bytes, contents: Contents, host: str = LOCALHOST, port: int = 0, folder: str = "/"
    ) -> None:
        """`port` 0 takes any free port. `folder` is the prefix of all paths, with both slashes.

        Raises OutputError if the port is in use.
        """
        application: Contents = {
            "": ("text/html; charset=utf-8", lambda: BytesIO(page)),
            SCRIPT: ("text/javascript; charset=utf-8", lambda: BytesIO(asset(SCRIPT))),
            STYLE: ("text/css; charset=utf-8", lambda: BytesIO(asset(STYLE))),
        }
        everything = {folder + name: content for name, content in {**application, **contents}.items()}
        everything["/favicon.ico"] = ("image/x-icon", lambda: BytesIO())
        self._folder = folder
        try:
            kind = _ServerIPv6 if ":" in host else ThreadingHTTPServer
            self._server = kind((host, port), _handler(everything, host in _LOCAL_NAMES))
        except (OSError, OverflowError) as error:
            raise OutputError(f"cannot serve on {host}, port {port}: {error}") from error
        self._server.daemon_threads = True

    @property
    def address(self) -> str:
        """The URL of the page."""
        host, port = self._server.server_address[:2]
        name = f"[{host!s}]" if ":" in str(host) else host
        return f"http://{name!s}:{port}{self._folder}"

    def run(self) -> None:
        """Serve until another thread calls `close`, or a signal ends it."""
        try:
            self._server.serve_forever(poll_interval=0.2)
        finally:
            self._server.server_close()

    def close(self) -> None:
        """End `run`."""
        self._server.shutdown()


class ModelServer(PageServer):
    """Serves the page and one model."""

    def __init__(
        self, model: Path | str, host: str = LOCALHOST, port: int = 0, look: Look | None = None
    ) -> None:
        """`port` 0 takes any free port. Warns (KeyssWarning) if the model is converted for the page.

        Raises InputError if `model` is not a model, OutputError if the port is in use.
        """
        file = readable(Path(model))
        page = served_page("keyss-model", f"model/{quote(file.name)}", look or {})
        super().__init__(page, {f"model/{file.name}": ("application/octet-stream", file.open)}, host, port)


def _handler(contents: Contents, local: bool) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "keyss", ""
        timeout = 30

        def do_GET(self) -> None:
            try:
                host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
            except ValueError:
                self.send_error(HTTPStatus.BAD_REQUEST)
                return
            # DNS rebinding: another site's name resolves to this server, whose model it must not read.
            if local and host not in _LOCAL_NAMES:
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            content = contents.get(unquote(urlsplit(self.path).path))
            if content is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            media_type, opened = content
            try:
                with opened() as file:
                    size = file.seek(0, 2)
                    file.seek(0)
                    self.send_response(HTTPStatus.OK)
                    for name, value in _headers(media_type, size).items():
                        self.send_header(name, value)
                    self.end_headers()
                    shutil.copyfileobj(file, self.wfile)
            except OSError:  # the client has left, or the model is gone
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    return Handler


def _headers(media_type: str, size: int) -> dict[str, str]:
    return {
        "Content-Type": media_type,
        "Content-Length": str(size),
        "Content-Security-Policy": f"{served_policy()}; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }
