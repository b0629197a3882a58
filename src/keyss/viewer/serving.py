"""The page over HTTP, for this machine unless told otherwise: with one model, or whatever else is given."""

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
from keyss.viewer.page import SCRIPT, STYLE, asset, page_beside, served_policy
from keyss.viewer.showing import shown

LOCALHOST = "127.0.0.1"
_LOCAL_NAMES = {"127.0.0.1", "localhost", "::1"}
# What is given out at an address: its type, and what opens it or raises OSError.
Contents = Mapping[str, tuple[str, Callable[[], BinaryIO]]]


class _ServerIPv6(ThreadingHTTPServer):
    address_family = socket.AF_INET6


class PageServer:
    """A server of the page and of `contents`. Nothing else is given out, whatever is asked."""

    def __init__(
        self, page: bytes, contents: Contents, host: str = LOCALHOST, port: int = 0, folder: str = "/"
    ) -> None:
        """`port` 0: any that is free. `folder`: where all of it lies, between slashes.

        Raises OutputError for a port in use.
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
        """Where the page is."""
        host, port = self._server.server_address[:2]
        name = f"[{host!s}]" if ":" in str(host) else host
        return f"http://{name!s}:{port}{self._folder}"

    def run(self) -> None:
        """Serve until `close` is called by another thread, or a signal ends it."""
        try:
            self._server.serve_forever(poll_interval=0.2)
        finally:
            self._server.server_close()

    def close(self) -> None:
        self._server.shutdown()


class ModelServer(PageServer):
    """A server of the page and one model."""

    def __init__(self, model: Path | str, host: str = LOCALHOST, port: int = 0, up: str = "-y") -> None:
        """`port` 0: any that is free. Warns (KeyssWarning) of a model that is converted for the page.

        Raises InputError for what is no model, and OutputError for a port in use.
        """
        found = shown(Path(model))
        page = page_beside(f"model/{quote(found.name)}", up)
        super().__init__(page, {f"model/{found.name}": ("application/octet-stream", found.open)}, host, port)


def _handler(contents: Contents, local: bool) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "keyss", ""
        timeout = 30

        def do_GET(self) -> None:
            self._answer(with_content=True)

        def do_HEAD(self) -> None:
            self._answer(with_content=False)

        def _answer(self, *, with_content: bool) -> None:
            # Another site whose name leads here must not read the model through a visitor's browser.
            try:
                asked = urlsplit(f"//{self.headers.get('Host', '')}").hostname
            except ValueError:
                self.send_error(HTTPStatus.BAD_REQUEST)
                return
            found = contents.get(unquote(urlsplit(self.path).path))
            if local and asked not in _LOCAL_NAMES:
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            if found is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            kind, opened = found
            try:
                with opened() as file:
                    size = file.seek(0, 2)
                    file.seek(0)
                    self.send_response(HTTPStatus.OK)
                    for name, value in _headers(kind, size).items():
                        self.send_header(name, value)
                    self.end_headers()
                    if with_content:
                        shutil.copyfileobj(file, self.wfile)
            except OSError:  # whoever asked has left, or the model is gone
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            """Nobody reads it."""

    return Handler


def _headers(kind: str, size: int) -> dict[str, str]:
    return {
        "Content-Type": kind,
        "Content-Length": str(size),
        "Content-Security-Policy": f"{served_policy()}; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }
