"""nerfstudio's viewer, for this machine alone.

viser 0.2.7 serves any file of the machine, to pages of any origin, and has no option for either; and it
counts a client whose message it can't read forever. So `guard_viewers` puts a check before every request and
message to the servers that this process starts. docs/troubleshooting.md lists what it allows. Nor does viser
build its page anew here: the one of its wheel is complete, and looking whether it is being built reads every
process of the machine, which fails when one of them ends meanwhile.
"""

from __future__ import annotations

import re
from functools import partial
from http import HTTPStatus
from typing import Any

import viser.infra._infra as infra
import websockets.server
from nerfstudio.configs.base_config import ViewerConfig
from viser import _client_autobuild, _messages

from lang3dxl_ns.common.checks import check_address
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.web.access import Access, is_local

HOST = "127.0.0.1"
ONLY_HERE = (
    "nerfstudio's viewer opens on this machine alone. From another: ssh -L 7007:127.0.0.1:7007 MACHINE; "
    "a finished run opens to others with lang3dxl view --host 0.0.0.0"
)
_FILE = re.compile(r"/(\w[\w.-]*(/\w[\w.-]*)*)?(\?.*)?")
"""Addresses of files below the page's folder: no part of one begins with a dot."""


def check_viewer(viewer: ViewerConfig) -> None:
    """Raise UserError for settings that would open the viewer to others, or an address that is in use."""
    if viewer.make_share_url or not is_local(viewer.websocket_host):
        raise UserError(f"--viewer.websocket-host, --viewer.make-share-url: {ONLY_HERE}")
    check_address(viewer.websocket_host, viewer.websocket_port)


def guard_viewers() -> None:
    """Keep every further viser server of this process on this machine, and its files to those of its page."""
    module: Any = websockets.server
    serve, handle = module.serve, infra.WebsockMessageHandler._handle_incoming_message
    consume: Any = infra._message_consumer
    if getattr(serve, "is_guarded", False):
        return

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        if not is_local(host):
            say(ONLY_HERE)
        checked = partial(_answered, Access(HOST, port), process_request)
        return serve(handler, HOST, port, process_request=checked, **options)

    def guarded_handle(self: infra.WebsockMessageHandler, client_id: Any, message: Any) -> None:
        # A minimized window has no aspect ratio, and the thread that renders would end at it.
        if not isinstance(message, _messages.ViewerCameraMessage) or 0.02 < message.aspect < 50:
            handle(self, client_id, message)

    async def guarded_consume(websocket: Any, *rest: Any) -> None:
        try:
            await consume(websocket, *rest)
        except websockets.exceptions.ConnectionClosed:
            raise
        except Exception as error:  # viser lets anything through, and would answer this client no more
            say(f"a viewer was disconnected, as the page sends no such message ({error!r:.80})")
            await websocket.close(1007)
            await websocket.recv()  # raises what viser takes for the end of a connection

    if (_client_autobuild.build_dir / "index.html").exists():
        _client_autobuild.ensure_client_is_built = lambda: None
    guarded_serve.is_guarded = True  # type: ignore[attr-defined]
    module.serve = guarded_serve
    infra._message_consumer = guarded_consume  # type: ignore[assignment]
    infra.WebsockMessageHandler._handle_incoming_message = guarded_handle  # type: ignore[method-assign]


async def _answered(access: Access, viser: Any, path: str, headers: Any) -> Any:
    """Refuse a request for another host, from a page of another origin, or for a file that is not the page's;
    leave the others to viser (None continues a websocket's handshake)."""
    if (refused := access.refusal(path, headers)) is not None:
        return refused
    upgrades = headers.get_all("Upgrade")
    if upgrades == ["websocket"]:
        return None
    if upgrades or not _FILE.fullmatch(path):
        return HTTPStatus.NOT_FOUND, {}, b"404"
    return await viser(path, headers)
