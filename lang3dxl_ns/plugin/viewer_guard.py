"""Access control of nerfstudio's viewers: who may open them, and which files and messages they accept.

viser 0.2.7 serves any file of the machine, answers pages of any origin, and has no hook for either. So
`guard_viewers` puts a guard before every server that this process starts. docs/troubleshooting.md lists what
the guard allows.
"""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import viser.infra._infra as infra
import websockets.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.legacy.server import WebSocketServerProtocol

from lang3dxl_ns.web.access import Access, Response

RENDER_NAME = "Render name"
"""Label of nerfstudio's text box whose content becomes a file name."""
_SHARING = (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect)
_FAR = 1e6
"""Largest coordinate of a viewer's camera."""
_COUNTER = re.compile(r"<!-- Google tag.*?</script>.*?</script>", re.DOTALL)
"""Pattern of the visit counter in viser's page."""
_NARROW = """<style>#narrow { display: none; padding: 1em; font: 16px system-ui, sans-serif; }
@media (max-width: 576px) { #root { display: none; } #narrow { display: block; } }</style>
<p id="narrow">nerfstudio's viewer fails in windows this narrow: turn the phone, or widen the window, and load
the page again. A finished run opens on any phone with lang3dxl view.</p></body>"""


@dataclass
class Guard(Access):
    """Access rules of one viser server."""

    root: Path | None = None
    """Folder of viser's page files."""

    @property
    def who_may_look(self) -> str:
        """Description, in Markdown, of who can open the page and how to change that."""
        if not self.needs_token:
            others = "`--viewer.websocket-host 0.0.0.0` opens it to others."
            return f"Only this machine can open the viewer, at `{self.address}`. {others}"
        where = "viser's share tunnel" if self.public else "the network"
        return f"Others can open the viewer through {where} at this address, token included: `{self.address}`"

    def response(self, path: str, headers: Headers) -> Response | None:
        """Return the response to a request; None if viser should respond."""
        refused = self.refusal(path, headers)
        if refused is not None or _is_handshake(headers):
            return refused
        file = self.file(path)
        if file is None or len(headers.get_all("Upgrade")) > 1:
            return HTTPStatus.NOT_FOUND, {}, b"404"
        if file != "/index.html" or self.root is None:
            return None
        html = _COUNTER.sub("", (self.root / "index.html").read_text()).replace("</body>", _NARROW)
        return HTTPStatus.OK, {"Content-Type": "text/html; charset=utf-8"}, html.encode()

    def file(self, path: str) -> str | None:
        """Resolve a path to the plainest address of the page's file that it names; None if it names none."""
        try:
            root = (self.root or Path("/none")).resolve()
            file = (root / (urlsplit(path).path.lstrip("/") or "index.html")).resolve()
            inside = file.is_relative_to(root) and file.is_file()
        except (ValueError, OSError):  # the path is not an address, or cannot be a file's
            return None
        return f"/{file.relative_to(root).as_posix()}" if inside else None

    def admits(self, handler: infra.WebsockMessageHandler, message: Any) -> bool:
        """Return whether viser may receive a page's message. Names of files are stripped of paths."""
        if isinstance(message, _SHARING):
            return self.public
        if isinstance(message, _messages.ViewerCameraMessage):
            return is_camera(message)
        if isinstance(message, _messages.GuiUpdateMessage):
            known, value = _input(handler, message.id), message.updates.get("value")
            if known is not None and known._impl.label == RENDER_NAME:
                message.updates["value"] = file_name(str(value))
            # A page may neither change the kind of an input nor choose a value that it doesn't offer.
            return list(message.updates) == ["value"] and value in getattr(known, "options", [value])
        return True


def _is_handshake(headers: Headers) -> bool:
    """Return whether a request opens a websocket; viser treats any other request as one for a file."""
    return [value.lower() for value in headers.get_all("Upgrade")] == ["websocket"]


def is_camera(message: _messages.ViewerCameraMessage) -> bool:
    """Return whether this camera can be rendered: for example, a minimized window has no aspect ratio."""
    vectors = (message.wxyz, message.position, message.look_at, message.up_direction)
    return (
        [len(vector) for vector in vectors] == [4, 3, 3, 3]
        and all(abs(x) < _FAR for vector in vectors for x in vector)
        and 0.5 < math.hypot(*message.wxyz) < 2
        and math.dist(message.position, message.look_at) > 0
        and 0.01 < message.fov < math.pi - 0.01
        and 0.02 < message.aspect < 50
    )


def _input(handler: infra.WebsockMessageHandler, name: str) -> Any:
    """Find an input by its name, through viser's handler, which alone knows the interface."""
    for callback in handler._incoming_handlers.get(_messages.GuiUpdateMessage, ()):
        known = getattr(callback, "__self__", None)
        if known is not None and name in known._gui_input_handle_from_id:
            return known._gui_input_handle_from_id[name]
    return None


def file_name(text: str) -> str:
    """Turn a text into a file name without a folder: letters, digits, space, `_`, `-` and inner dots."""
    return re.sub(r"[^\w .-]+", "-", text).strip(" .-")[:80] or "render"


# ── installing it in viser's servers ────────────────────────────────────────────────────────────────────


def guard_viewers() -> None:
    """Start every further viser server of this process behind a `Guard` (its attribute `guard`)."""
    if getattr(infra.WebsockServer, "is_guarded", False):
        return
    start, handle = infra.WebsockServer.start, infra.WebsockMessageHandler._handle_incoming_message

    def guarded_start(self: infra.WebsockServer) -> None:
        self.guard = guard = Guard(self._host, self._port, root=self._http_server_root)  # type: ignore[attr-defined]
        self.on_client_connect(lambda connection: setattr(connection, "guard", guard))
        module: Any = websockets.server
        serve = module.serve
        module.serve = partial(serve, create_protocol=partial(GuardedProtocol, guard))  # viser has no option
        try:
            start(self)
        finally:
            module.serve = serve
        guard.port = self._port  # the port differs if the requested one was taken

    def guarded_handle(self: infra.WebsockMessageHandler, client_id: Any, message: Any) -> None:
        guard: Guard | None = getattr(self, "guard", None)
        # Drop messages with fields of other types, and those before the camera that makes a client known.
        with contextlib.suppress(TypeError, ValueError, AttributeError, LookupError, AssertionError):
            if guard is None or guard.admits(self, message):
                handle(self, client_id, message)

    infra.WebsockServer.start = guarded_start  # type: ignore[method-assign]
    infra.WebsockMessageHandler._handle_incoming_message = guarded_handle  # type: ignore[method-assign]
    infra.WebsockServer.is_guarded = True  # type: ignore[attr-defined]


class GuardedProtocol(WebSocketServerProtocol):
    """A websocket connection that consults the guard first."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.guard = guard

    async def process_request(self, path: str, request_headers: Headers) -> Any:
        """Answer the request, or pass it on to viser: a file by the address that the guard resolved, since
        viser reads addresses and headers in other ways."""
        response = self.guard.response(path, request_headers)
        if response is not None or _is_handshake(request_headers):
            return response
        plain = Headers({"Accept-Encoding": ", ".join(request_headers.get_all("Accept-Encoding"))})
        return await super().process_request(self.guard.file(path) or "/none", plain)

    async def recv(self) -> Any:
        """Return the next valid message; viser would end at an invalid one with a traceback."""
        while True:
            raw = await super().recv()
            with contextlib.suppress(Exception):  # any kind of error
                _messages.Message.deserialize(raw)  # type: ignore[arg-type]
                return raw
