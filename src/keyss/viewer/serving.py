"""Serves the page over HTTP, by default on this machine only.

The URL has a random part, which other users of the machine do not know: the model may be a secret.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from keyss.core.errors import OutputError
from keyss.viewer.look import Look
from keyss.viewer.page import SCRIPT, SERVED_POLICY, STYLE, asset, readable, served_page

LOCALHOST = "127.0.0.1"
Contents = Mapping[str, tuple[str, bytes]]  # media type and content, by path


class _ServerIPv6(ThreadingHTTPServer):
    address_family = socket.AF_INET6


class ModelServer:
    """Serves the page and one model, and nothing else."""

    def __init__(
        self, model: Path | str, host: str = LOCALHOST, port: int = 0, look: Look | None = None
    ) -> None:
        """`port` 0 takes any free port. Warns (KeyssWarning) if the model is converted for the page.

        Raises InputError if `model` is not a model, OutputError if the port is in use.
        """
        name, data = readable(Path(model))
        page = served_page(f"model/{quote(name)}", look or {})
        self._folder = f"/{secrets.token_urlsafe(16)}/"
        contents: Contents = {
            self._folder: ("text/html; charset=utf-8", page),
            self._folder + SCRIPT: ("text/javascript; charset=utf-8", asset(SCRIPT)),
            self._folder + STYLE: ("text/css; charset=utf-8", asset(STYLE)),
            f"{self._folder}model/{name}": ("application/octet-stream", data),
            "/favicon.ico": ("image/x-icon", b""),
        }
        try:
            kind = _ServerIPv6 if ":" in host else ThreadingHTTPServer
            self._server = kind((host, port), BaseHTTPRequestHandler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            cure = "leave out `port` for any free one"
            raise OutputError(f"cannot serve on {host}, port {port}: {reason}; {cure}") from error
        self._server.daemon_threads = True
        self._ip = ipaddress.ip_address(str(self._server.server_address[0]))
        # Accepted `Host` headers; None accepts all, if the server listens on all addresses.
        local = {"localhost"} if self.is_local else set()
        names = None if self._ip.is_unspecified else {host.lower(), _in_url(self._ip)} | local
        self._server.RequestHandlerClass = _handler(contents, names)

    @property
    def address(self) -> str:
        """The URL of the page, which cannot be guessed."""
        return f"http://{_in_url(self._ip)}:{self._server.server_address[1]}{self._folder}"

    @property
    def is_local(self) -> bool:
        """True if only this machine can connect."""
        return self._ip.is_loopback

    def run(self) -> None:
        """Serve until another thread calls `close`, or a signal ends it."""
        try:
            self._server.serve_forever(poll_interval=0.2)
        finally:
            self._server.server_close()

    def close(self) -> None:
        """End `run`."""
        self._server.shutdown()


def _in_url(ip: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str:
    return f"[{ip}]" if ip.version == 6 else str(ip)


def _handler(contents: Contents, names: set[str] | None) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "keyss", ""
        timeout = 30

        def do_GET(self) -> None:
            # Against DNS rebinding, in which another site's name resolves to this server. Ports are ignored:
            # a tunnel has its own.
            hosts = [re.sub(":[0-9]+$", "", host.lower()) for host in self.headers.get_all("Host", [])]
            if names is not None and (len(hosts) != 1 or hosts[0] not in names):
                self.send_error(HTTPStatus.FORBIDDEN)
                return
            media_type, content = contents.get(unquote(urlsplit(self.path).path), ("", None))
            if content is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            headers = {
                "Content-Type": media_type,
                "Content-Length": str(len(content)),
                "Content-Security-Policy": f"{SERVED_POLICY}; frame-ancestors 'none'",
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cross-Origin-Resource-Policy": "same-origin",
                "Cache-Control": "no-store",
            }
            try:
                self.send_response(HTTPStatus.OK)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)
            except OSError:  # the client disconnected
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    return Handler
