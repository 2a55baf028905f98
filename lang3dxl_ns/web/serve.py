"""The server of `lang3dxl view`: the page's own files, and any text encoded by the scene's CLIP."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from urllib.parse import parse_qsl, urlsplit

from lang3dxl_ns.common.checks import disk_trouble
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.web.access import Access
from lang3dxl_ns.web.write_page import Page

FIRST_PORT, PORTS = 7007, 20
"""First port, and number of ports, that are tried if none is requested."""
_PATIENCE = 30.0
"""Seconds that a connection may stay silent before it is closed."""
_PART = 65536
"""Bytes that are sent at a time."""
_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "jpg": "image/jpeg",
    "txt": "text/plain; charset=utf-8",
}
_MOST_MARKS = 8_000_000
"""Most bytes of a word's marks."""
_BYTES = "application/octet-stream"
_HEADERS = {
    "Cache-Control": "no-cache",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class PageServer(ThreadingHTTPServer):
    """Server of one live page from memory, until `shutdown`. Without a port, it takes the first free one from
    7007 on. Raises UserError if the port is taken, or the address is not this machine's."""

    daemon_threads = True

    def __init__(self, page: Page, host: str = "127.0.0.1", port: int | None = None) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.access, self.page = Access(host, 0), page
        for tried in [*range(FIRST_PORT, FIRST_PORT + PORTS), 0] if port is None else [port]:
            try:
                super().__init__((host, tried), Handler)
                break
            except (OSError, OverflowError) as error:
                reason = error
        else:
            ask = host if port is None else f"port {port} of {host}"
            raise UserError(f"nothing can be served at {ask} ({reason}): choose another --port or --host")
        self.access.port = self.server_port
        self.files = page.files()

    def server_bind(self) -> None:
        """Bind without resolving this machine's name, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_port = self.server_address[1]

    def answer(self, path: str) -> tuple[HTTPStatus, str, bytes]:
        """Return status, type and content for a path of the page or of its API."""
        place = urlsplit(path)
        values = dict(parse_qsl(place.query))
        if place.path == "/api/encode":
            answer = self.page.answer(values.get("text", ""))
            return HTTPStatus.OK, _KINDS["json"], json.dumps(answer).encode()
        if place.path == "/api/look":
            return HTTPStatus.OK, _BYTES, self.page.colors(values.get("photo", ""))
        if place.path == "/api/floaters":
            return HTTPStatus.OK, _BYTES, self.page.floaters()
        if place.path == "/api/photo":
            return HTTPStatus.OK, "image/jpeg", self.page.photo(values.get("name", ""))
        name = place.path.removeprefix("/") or "index.html"
        if name not in self.files:
            return HTTPStatus.NOT_FOUND, "text/plain", b"404\n"
        content = self.files[name]
        if name == "scene.json":  # a new tab opens with the tour that was kept last
            content = json.dumps(json.loads(content) | {"tour": self.page.provenance.tour}).encode()
        return HTTPStatus.OK, _KINDS.get(name.rpartition(".")[2], _BYTES), content


class Handler(BaseHTTPRequestHandler):
    """Handler of one connection to a `PageServer`."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "lang3dxl", ""
    timeout = _PATIENCE

    def handle(self) -> None:
        """Answer requests until the connection ends, however abruptly the browser ends it."""
        with contextlib.suppress(ConnectionError):
            super().handle()

    def do_GET(self) -> None:
        """Answer the request, unless access is refused."""
        if self.headers.get("Transfer-Encoding") or self.headers.get("Content-Length", "0") != "0":
            self.close_connection = True  # the body, which nothing reads, is not another request
        self._answer(lambda: self.server.answer(self.path))

    def do_POST(self) -> None:
        """Teach the scene a word, or keep a tour, for a page of this server that may be used."""
        self.close_connection = True  # what is not read of the body is not another request
        self._answer(self._keep)

    def _keep(self) -> tuple[HTTPStatus, str, bytes]:
        size = int(self.headers.get("Content-Length") or 0)
        # Browsers name the origin of every POST; other sites can't send JSON without asking first.
        ours = self.headers.get("Origin") and self.headers.get("Content-Type") == _KINDS["json"]
        page, path = self.server.page, urlsplit(self.path).path
        keep = {"/api/teach": page.teach, "/api/tour": page.keep_tour}.get(path)
        if keep is None or not ours or not 0 < size <= _MOST_MARKS:
            raise UserError("this server takes the marks of a word only from its own page")
        try:
            content = json.loads(self.rfile.read(size))
        except RecursionError as error:
            raise UserError("these are not marks of a word: load the page again") from error
        return HTTPStatus.OK, _KINDS["json"], json.dumps(keep(content)).encode()

    def _answer(self, answer: Callable[[], tuple[HTTPStatus, str, bytes]]) -> None:
        refused = self.server.access.refusal(self.path, self.headers)
        if refused is not None:
            return self._send(*refused)
        try:
            status, kind, content = answer()
        except (ConnectionError, TimeoutError):  # of the browser
            raise
        except (UserError, ValueError, OSError) as error:  # an impossible address raises ValueError
            status, kind = HTTPStatus.BAD_REQUEST, _KINDS["txt"]
            trouble = disk_trouble(error) if isinstance(error, OSError) else None
            content = (trouble or f"{error}").encode("utf-8", "replace")
        self._send(status, {"Content-Type": kind}, content)

    def _send(self, status: HTTPStatus, headers: Mapping[str, str], content: bytes) -> None:
        self.send_response(status)
        for name, value in {**_HEADERS, **headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        for start in range(0, len(content), _PART):  # each has the whole patience
            self.wfile.write(content[start : start + _PART])

    def log_message(self, *_: object) -> None:
        """Log nothing, where the parent would log every request."""
