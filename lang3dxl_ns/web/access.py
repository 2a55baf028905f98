"""Access to a viewer's server: checks of Host and Origin, and a token where other machines can reach it."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
EVERYWHERE = ("", "0.0.0.0", "::")
"""Addresses at which a server is reachable under all names of this machine."""
_TOKEN = "token"
Response = tuple[HTTPStatus, dict[str, str], bytes]


def is_local(host: str) -> bool:
    """Return whether only this machine can reach a server at this address."""
    with suppress(ValueError):  # the host may be a name
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


@dataclass
class Access:
    """Access rules of one server. One that only this machine can reach answers requests for the machine's own
    names (against DNS rebinding) from its own pages. One that others can reach answers clients that opened
    the address with the token, which becomes a cookie."""

    host: str
    port: int
    token: str = field(default_factory=partial(secrets.token_urlsafe, 16))

    @property
    def needs_token(self) -> bool:
        """Whether clients need the token, since other machines can reach the server."""
        return not is_local(self.host)

    @property
    def address(self) -> str:
        """URL to open in a browser on this machine."""
        host = "localhost" if self.host in EVERYWHERE else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?{_TOKEN}={self.token}" if self.needs_token else "")

    @property
    def elsewhere(self) -> str | None:
        """URL to open on other machines, if this server takes requests at all addresses of this one."""
        return replace(self, host=_own_address()).address if self.host in EVERYWHERE else None

    def refusal(self, path: str, headers: Any) -> Response | None:
        """Return the response to a refused request; None for one that may proceed. headers: as read by
        `http.server` or websockets, whose `get_all` returns all values of a name."""
        try:
            host, origin = _only(headers, "Host") or "", _only(headers, "Origin")
            # With a token any name passes.
            ours = self.needs_token or urlsplit(f"//{host}").hostname in (*LOCAL_NAMES, self.host)
            # Other sites' pages may link here, but not make this server work with pictures or scripts.
            site, mode = (headers.get(f"Sec-Fetch-{name}") for name in ("Site", "Mode"))
            if site == "cross-site" and mode != "navigate" and not self.needs_token:
                return _refused("This page answers its own requests alone.")
            if not ours or (origin is not None and not _same_site(origin, host)):
                return _refused(f"This page is not served to {origin or host}.")
            if not self.needs_token or self._knows_token(headers):
                return None
            if not self._is_token(parse_qs(urlsplit(path).query).get(_TOKEN, [""])[0]):
                return _refused("Open the address with its token, which the terminal shows.")
        except ValueError as error:
            return HTTPStatus.BAD_REQUEST, {"Content-Type": "text/plain"}, f"{error}\n".encode()
        # Remove the token from the address, which the page could pass on. Strict would not send the cookie to
        # that address if the link was followed from another site, such as a chat.
        cookie = f"viewer-{self.port}={self.token}; Path=/; HttpOnly; SameSite=Lax"
        return HTTPStatus.SEE_OTHER, {"Set-Cookie": cookie, "Location": "/"}, b""

    def _knows_token(self, headers: Any) -> bool:
        pairs = (pair.strip() for line in headers.get_all("Cookie") or [] for pair in line.split(";"))
        return any(self._is_token(pair.removeprefix(f"viewer-{self.port}=")) for pair in pairs)

    def _is_token(self, offered: str) -> bool:
        return secrets.compare_digest(offered.encode("utf-8", "replace"), self.token.encode())


def _same_site(origin: str, host: str) -> bool:
    site = urlsplit(origin)
    return site.scheme in ("http", "https") and site.netloc.lower() == host.lower()


def _own_address() -> str:
    """Return the address by which the network reaches this machine, or its name if it has no network."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # chooses a route, and sends nothing
        return str(probe.getsockname()[0])
    return socket.gethostname()


def _only(headers: Any, name: str) -> str | None:
    """Return a header's value, if any. Raises ValueError if it is given twice."""
    values = headers.get_all(name) or []
    if len(values) > 1:
        raise ValueError(f"{name} is given twice")
    return values[0] if values else None


def _refused(why: str) -> Response:
    return HTTPStatus.FORBIDDEN, {"Content-Type": "text/plain"}, f"{why}\n".encode("utf-8", "replace")
