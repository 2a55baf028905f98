"""Access control of viewers: which files and messages viser's server accepts, and from whom.

viser 0.2.7 serves any file of the machine, answers pages of any origin, and has no hook for either, so
`guard_viewers` puts a guard before every server that this process starts. docs/faults.md says what it allows.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
import math
import re
import secrets
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser.infra._infra as infra
import websockets.server
from viser import _messages
from viser._gui_handles import GuiDropdownHandle, _GuiInputHandle
from websockets.datastructures import Headers
from websockets.legacy.server import WebSocketServerProtocol

Response = tuple[http.HTTPStatus, Any, bytes]
TOKEN_PARAMETER = "token"
RENDER_NAME = "Render name"
"""Label of nerfstudio's text box whose content becomes a file name."""
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
SHARING = (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect)
IN_THE_SCENE = (
    _messages.ScenePointerMessage,
    _messages.SceneNodeClickMessage,
    _messages.TransformControlsUpdateMessage,
    _messages.GetRenderResponseMessage,
)
"""Other messages that pages send; none of these viewers' inputs takes a file."""
FAR = 1e6
"""Largest coordinate of a viewer's camera."""
LONGEST_TEXT = 10_000
"""Most characters of a text box."""


def is_local(host: str) -> bool:
    """Whether a server at this address can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class Guard:
    """Access rules of one server.

    A server on a loopback address answers only pages that it served itself. One that others can reach answers
    clients that opened the address with the token (which becomes a cookie).
    """

    host: str
    port: int
    root: Path | None
    """Folder of the page's files."""
    token: str = field(default_factory=partial(secrets.token_urlsafe, 16))
    share: bool = False
    """Whether the page may be made public through viser's share tunnel."""

    @property
    def needs_token(self) -> bool:
        """Whether other machines can reach the server."""
        return self.share or not is_local(self.host)

    @property
    def address(self) -> str:
        """URL to open in a browser on this machine."""
        host = "localhost" if self.host in ("", "0.0.0.0", "::") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}" + (
            f"/?{TOKEN_PARAMETER}={self.token}" if self.needs_token else ""
        )

    @property
    def who_may_look(self) -> str:
        """Markdown about who can open the page, and how to change that."""
        address = f"`{self.address}`"
        if not self.needs_token:
            others = "`--viewer.websocket-host 0.0.0.0` (in `lang3dxl view`: `--host`) opens it to others."
            return f"Only this machine can open the viewer, at {address}. {others}"
        if is_local(self.host):
            return f"The viewer is public through viser's share tunnel, to anyone with its token: {address}"
        return (
            f"Others can open the viewer ({self.host}) at this address, token included: {address} (replace "
            "`localhost` by this machine's name). `--viewer.websocket-host 127.0.0.1` keeps it private."
        )

    def refusal(self, path: str, headers: Headers) -> Response | None:
        """The response to a refused request; None for one that may proceed."""
        try:
            host, origin = headers.get("Host", ""), headers.get("Origin")
            place = urlsplit(path)
            if not self._is_ours(host) or (origin is not None and not self._same_site(origin, host)):
                return _refuse(f"This viewer is not served to {origin or host}.")
            if self.needs_token and not self._knows_token(headers):
                if not self._is_token(parse_qs(place.query).get(TOKEN_PARAMETER, [""])[0]):
                    return _refuse("Open the address with its token, which the viewer's terminal shows.")
                # Remove the token from the address, which the page could pass on.
                cookie = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
                return http.HTTPStatus.SEE_OTHER, {"Set-Cookie": cookie, "Location": "/"}, b""
            if is_handshake(headers) or self.file(path) is not None:
                return None
        except (ValueError, LookupError):  # an invalid address, or a header given twice
            pass
        return http.HTTPStatus.NOT_FOUND, {}, b"404"

    @property
    def _cookie(self) -> str:
        return f"viewer-{self.port}"

    def _is_ours(self, host: str) -> bool:
        """Whether the host name is ours, against DNS rebinding; with a token, the token protects."""
        return self.needs_token or urlsplit(f"//{host}").hostname in (*LOCAL_NAMES, self.host)

    def _same_site(self, origin: str, host: str) -> bool:
        site = urlsplit(origin)
        own = site.scheme in ("http", "https") and site.netloc.lower() == host.lower()
        return own or (self.share and (site.hostname or "").endswith(".viser.studio"))

    def _knows_token(self, headers: Headers) -> bool:
        for line in headers.get_all("Cookie"):
            with contextlib.suppress(CookieError):
                cookie = SimpleCookie(line).get(self._cookie)
                if cookie is not None and self._is_token(cookie.value):
                    return True
        return False

    def _is_token(self, offered: str) -> bool:
        return secrets.compare_digest(offered.encode(), self.token.encode())

    def file(self, path: str) -> str | None:
        """The address, in its plainest form, of the page's file that a path names; None if it names none."""
        try:
            root = (self.root or Path("/none")).resolve()
            file = (root / (urlsplit(path).path.lstrip("/") or "index.html")).resolve()
            inside = file.is_relative_to(root) and file.is_file()
        except (ValueError, OSError):  # no address, or none that a file could have
            return None
        return f"/{file.relative_to(root).as_posix()}" if inside else None

    # ── messages ────────────────────────────────────────────────────────────────────────────────────────

    def admits(self, handler: infra.WebsockMessageHandler, message: Any) -> bool:
        """Whether to handle a page's message; limits its contents to valid values."""
        if isinstance(message, SHARING):
            return self.share
        try:
            if isinstance(message, _messages.GuiUpdateMessage):
                return _is_update(handler, message)
            if isinstance(message, _messages.ViewerCameraMessage):
                return is_camera(message)
            return isinstance(message, IN_THE_SCENE) and _is_sound(list(vars(message).values()))
        except (TypeError, ValueError, AttributeError, ArithmeticError):  # fields of other types
            return False


def is_handshake(headers: Headers) -> bool:
    """Whether a request opens a websocket instead of asking for a file. LookupError for two answers."""
    return headers.get("Upgrade", "").lower() == "websocket"


def _refuse(why: str) -> Response:
    return http.HTTPStatus.FORBIDDEN, {"Content-Type": "text/plain"}, f"{why}\n".encode()


def is_camera(message: _messages.ViewerCameraMessage) -> bool:
    """Whether one can render from this camera: a minimized window has no aspect ratio, for example."""
    vectors = (message.wxyz, message.position, message.look_at, message.up_direction)
    return (
        [len(vector) for vector in vectors] == [4, 3, 3, 3]
        and all(isinstance(x, int | float) for vector in vectors for x in vector)
        and _is_sound(vectors)
        and 0.5 < math.hypot(*message.wxyz) < 2
        and math.dist(message.position, message.look_at) > 0
        and 0.01 < message.fov < math.pi - 0.01
        and 0.02 < message.aspect < 50
    )


def _is_sound(value: Any) -> bool:
    """Whether all numbers in a message are finite and reasonable."""
    if isinstance(value, int | float):
        return abs(value) < FAR
    return all(map(_is_sound, value)) if isinstance(value, tuple | list) else True


def _is_update(handler: infra.WebsockMessageHandler, message: _messages.GuiUpdateMessage) -> bool:
    """Whether an input gets a valid value. File names are stripped of paths."""
    if not isinstance(message.updates, dict) or set(message.updates) != {"value"}:
        return False  # pages may set nothing else of an input
    handle, value = _input(handler, message.id), message.updates["value"]
    if handle is None:
        return False
    if isinstance(handle, GuiDropdownHandle):
        return value in handle.options
    if isinstance(value, str):
        if handle._impl.label == RENDER_NAME:
            message.updates["value"] = file_name(value)
        return isinstance(handle.value, str) and len(value) <= LONGEST_TEXT
    if isinstance(handle.value, str):
        return False
    numbers = value if isinstance(value, tuple) else (value,)
    known = handle.value if isinstance(handle.value, tuple) else (handle.value,)
    kinds = all(isinstance(x, int | float) for x in numbers)
    return len(numbers) == len(known) and kinds and _is_sound(numbers)


def _input(handler: infra.WebsockMessageHandler, name: str) -> _GuiInputHandle | None:
    """viser's handle of an input; only the handler knows the interface."""
    for callback in handler._incoming_handlers.get(_messages.GuiUpdateMessage, ()):
        known = getattr(callback, "__self__", None)
        if known is not None and name in known._gui_input_handle_from_id:
            return known._gui_input_handle_from_id[name]
    return None


def file_name(text: str) -> str:
    """The text as a file name in a folder: letters, digits, space, `_`, `-` and inner dots."""
    return re.sub(r"[^\w .-]+", "-", text).strip(" .-")[:80] or "render"


# ── installing it in viser's servers ────────────────────────────────────────────────────────────────────


def guard_viewers() -> None:
    """Start every further viser server of this process behind a `Guard` (its attribute `guard`)."""
    if getattr(infra.WebsockServer, "is_guarded", False):
        return
    start, handle = infra.WebsockServer.start, infra.WebsockMessageHandler._handle_incoming_message

    def guarded_start(self: infra.WebsockServer) -> None:
        self.guard = guard = Guard(self._host, self._port, self._http_server_root)  # type: ignore[attr-defined]
        self.on_client_connect(lambda connection: setattr(connection, "guard", guard))
        self._client_disconnect_cb.insert(0, lambda connection: setattr(connection, "left", self))
        with _serving(partial(GuardedProtocol, guard)):
            start(self)
        guard.port = self._port  # differs if the port was taken

    def guarded_handle(self: infra.WebsockMessageHandler, client_id: Any, message: Any) -> None:
        guard: Guard | None = getattr(self, "guard", None)
        if guard is None or guard.admits(self, message):
            handle(self, client_id, message)
        # A page that left before its first message was handled would count as present for ever.
        left: infra.WebsockServer | None = getattr(self, "left", None)
        for forget in () if left is None else left._client_disconnect_cb:
            forget(self)  # type: ignore[arg-type]

    infra.WebsockServer.start = guarded_start  # type: ignore[method-assign]
    infra.WebsockMessageHandler._handle_incoming_message = guarded_handle  # type: ignore[method-assign]
    infra.WebsockServer.is_guarded = True  # type: ignore[attr-defined]


@contextlib.contextmanager
def _serving(protocol: Any) -> Iterator[None]:
    """While a server starts: make it use this protocol class, for which viser has no option."""
    module: Any = websockets.server
    serve = module.serve
    module.serve = partial(serve, create_protocol=protocol)
    try:
        yield
    finally:
        module.serve = serve


class GuardedProtocol(WebSocketServerProtocol):
    """A connection that asks the guard first, and closes on invalid messages."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.guard = guard

    async def process_request(self, path: str, request_headers: Headers) -> Any:
        """Refuse, or pass the request on to viser: only for a file, by the address that the guard resolved,
        since viser reads addresses and headers in other ways."""
        refusal = self.guard.refusal(path, request_headers)
        if refusal is not None or is_handshake(request_headers):
            return refusal
        return await super().process_request(self.guard.file(path) or "/none", request_headers)

    async def recv(self) -> Any:
        """The next message; viser would not notice that an invalid one ended the connection."""
        while True:  # until the connection is closed, which raises
            raw = await super().recv()
            try:
                if isinstance(raw, bytes):
                    _messages.Message.deserialize(raw)
                    return raw
            except Exception:  # decoding untrusted bytes can raise many kinds
                pass
            await self.close(1003, "not a message")
