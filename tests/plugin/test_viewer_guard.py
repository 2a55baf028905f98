"""nerfstudio's viewer stays on this machine, and serves its page and nothing else."""

import math
import socket
import subprocess
import time

import msgspec
import psutil
import pytest
import viser
from raw_http import get, reply
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lang3dxl_ns.plugin.viewer_guard import ONLY_HERE, guard_viewers

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 1.0,
    "aspect": 1.5,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}


@pytest.fixture(scope="module")
def viewer():
    """A viewer's server as nerfstudio starts it from our pipeline, told to be open to all."""
    guard_viewers()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer(host="0.0.0.0", port=port, verbose=False)
    server.port = server.get_port()
    yield server
    server.stop()


def session(server, **options):
    """A page's websocket."""
    options = {"origin": f"http://127.0.0.1:{server.port}", "open_timeout": 10, **options}
    return connect(f"ws://127.0.0.1:{server.port}", **options)


def test_it_listens_on_this_machine_alone_and_says_so(viewer, capsys):
    (listening,) = viewer._websock_server._ws_server.sockets
    assert listening.getsockname()[0] == "127.0.0.1"
    server = viser.ViserServer(host="0.0.0.0", port=viewer.port, verbose=False)  # takes the next free port
    assert server.get_port() != viewer.port
    server.stop()
    assert ONLY_HERE.split(":")[0] in " ".join(capsys.readouterr().out.split())


def test_its_page_is_not_built_anew_whatever_the_machine_does_meanwhile(viewer, monkeypatch):
    monkeypatch.setattr(subprocess, "run", fail)  # viser downloads Node for its page when files look newer
    monkeypatch.setattr(psutil, "process_iter", fail)  # and raises when a process ends while it looks at all
    server = viser.ViserServer(host="127.0.0.1", port=viewer.port, verbose=False)
    server.stop()


def fail(*_args, **_options):
    raise AssertionError("viser looks at the machine")


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../../../../../etc/passwd",
        "/assets/../../../../../../../../../../../etc/passwd",
        "//etc/passwd",
        "/./../build/../../_viser.py",
        "/%2e%2e/%2e%2e/_viser.py",
        "/assets/.hidden",
        "/\\..\\..",
        "http:///etc/passwd",
        "*",
    ],
)
@pytest.mark.parametrize("upgrade", ["", "WebSocket", "websocket", "h2c"])
def test_only_files_of_the_page_are_served(viewer, path, upgrade):
    answer = get(viewer, path, **({"Upgrade": upgrade, "Connection": "Upgrade"} if upgrade else {}))
    assert answer.status >= 400 and b"root:" not in answer.content and b"import" not in answer.content


def test_the_page_itself_is_served(viewer):
    for path in ("/", "/index.html", "/index.html?a=b", "/manifest.json"):
        assert get(viewer, path).status == 200
    assert b"<html" in get(viewer, "/").content
    with session(viewer) as socket_:
        assert socket_.recv(timeout=60)


def test_foreign_hosts_and_pages_are_refused(viewer):
    assert get(viewer, "/", host="evil.example").status == 403
    assert get(viewer, "/", Origin="http://evil.example").status == 403
    assert b"400" in reply(viewer, "GET / HTTP/1.1\nHost: 127.0.0.1:{port}\nHost: evil.example")[:20]
    for origin in ("http://evil.example", "null", "https://127.0.0.1:1"):
        with pytest.raises(InvalidStatus, match="403"):
            session(viewer, origin=origin)


@pytest.mark.parametrize("aspect", [0.0, math.nan, -1.0, math.inf])
def test_windows_without_an_aspect_ratio_are_passed_over(viewer, aspect):
    with session(viewer) as socket_:
        for shape in (aspect, 1.5):
            socket_.send(msgspec.msgpack.encode(CAMERA | {"aspect": shape}))
        end = time.monotonic() + 60
        while not (clients := viewer.get_clients()) and time.monotonic() < end:
            time.sleep(0.01)
        assert [client.camera.aspect for client in clients.values()] == [1.5]
    while viewer.get_clients() and time.monotonic() < end:
        time.sleep(0.01)


BAD = ["text", b"", b"\xc1", b"\x80", b"\x91" * 5_000, msgspec.msgpack.encode({"type": "NoSuchMessage"})]


@pytest.mark.parametrize("message", BAD)
def test_a_client_that_sends_no_message_of_the_page_is_forgotten(viewer, message):
    states = viewer._websock_server._client_state_from_id
    with session(viewer) as socket_:
        socket_.send(msgspec.msgpack.encode(CAMERA))
        until(viewer.get_clients)  # only then has viser finished to add it
        socket_.send(message)
        until(lambda: not viewer.get_clients() and not states)


def until(true):
    """Wait until something is true, at most a minute."""
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)
