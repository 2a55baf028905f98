"""Attacks on the viewer's port: files, other origins, share tunnels, host names, broken messages."""

import contextlib
import http.client
import math
import socket
import time

import msgspec
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lang3dxl_ns.query.web.viewer_guard import RENDER_NAME, Guard, file_name, guard_viewers

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 1.0,
    "aspect": 1.5,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 1.0, 0.0),
}


@contextlib.contextmanager
def serving():
    """A viewer's server, started by nerfstudio from our pipeline."""
    guard_viewers()
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    server.seen = []
    server.gui.add_slider("FPS", 1.0, 240.0, 1.0, 30.0).on_update(
        lambda e: server.seen.append(e.target.value)
    )
    server.gui.add_text(RENDER_NAME, "a").on_update(lambda e: server.seen.append(e.target.value))
    server.gui.add_dropdown("Path", ("one", "two")).on_update(lambda e: server.seen.append(e.target.value))
    server.request_share_url = lambda *_: server.seen.append("shared")
    yield server
    server.stop()


@pytest.fixture(scope="module")
def local():
    with serving() as server:
        yield server


@pytest.fixture(scope="module")
def wide():
    """A server that believes it is open to the network."""
    with serving() as server:
        server._websock_server.guard.host = "0.0.0.0"
        yield server


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def get(server, path: str, host: str | None = None, **headers: str) -> http.client.HTTPResponse:
    """The response to a path sent verbatim."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{server.get_port()}")
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.content = response.read()
    connection.close()
    return response


def reply(server, request: str) -> bytes:
    """What comes back for a request that no client library would send."""
    port = server.get_port()
    with socket.create_connection(("127.0.0.1", port), timeout=10) as raw:
        raw.sendall(request.format(port=port).replace("\n", "\r\n").encode() + b"\r\n\r\n")
        return b"".join(iter(lambda: raw.recv(1 << 16), b""))


def page(server, **options):
    """A page's websocket."""
    port = server.get_port()
    options = {"origin": f"http://127.0.0.1:{port}", "open_timeout": 10, **options}
    return connect(f"ws://127.0.0.1:{port}", **options)


def tell(socket_, **message) -> None:
    socket_.send(msgspec.msgpack.encode(message))


def handle_of(server, label: str):
    return next(h for h in server.gui._gui_input_handle_from_id.values() if h._impl.label == label)


def set_value(socket_, server, label: str, **updates) -> None:
    tell(socket_, type="GuiUpdateMessage", id=handle_of(server, label)._impl.id, updates=updates)


def heard(server, socket_) -> list:
    """The values of the inputs after all messages are processed."""
    fps = handle_of(server, "FPS")
    last = 200.0 if fps.value != 200.0 else 201.0
    time.sleep(0.1)  # messages are processed by several threads
    set_value(socket_, server, "FPS", value=last)
    for _ in range(500):
        if last in server.seen:
            break
        time.sleep(0.01)
    seen, server.seen = [x for x in server.seen if x != last], []
    return seen


# ── files ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../../../../../etc/passwd",
        "/assets/../../../../../../../../../../../etc/passwd",
        "//etc/passwd",
        "/./../build/../../_viser.py",
        "/%2e%2e/%2e%2e/_viser.py",
        "/assets",
        "/\\..\\..",
        "/" + "a" * 3000,
        "http:///etc/passwd",
        "*",
        "/a%00b",
    ],
)
def test_only_files_of_the_page_are_served(local, path):
    answer = get(local, path)
    assert answer.status in (403, 404)
    assert b"root:" not in answer.content and b"import" not in answer.content


@pytest.mark.parametrize("upgrade", ["WebSocket", "WEBSOCKET", "websocket", "websocket, x", "h2c", ""])
@pytest.mark.parametrize("name", ["etc/passwd", "proc/self/environ"])
def test_no_file_is_served_as_the_handshake_of_a_websocket(local, upgrade, name):
    answer = get(local, f"/../../../../../../../../../../{name}", Upgrade=upgrade, Connection="Upgrade")
    assert answer.status >= 400 and b"root:" not in answer.content and b"PATH=" not in answer.content


@pytest.mark.parametrize(
    "request_",
    [
        "GET / HTTP/1.1\nHost: 127.0.0.1:{port}\nHost: evil.example",
        "GET / HTTP/1.1\nHost: 127.0.0.1:{port}\nOrigin: http://127.0.0.1:{port}\nOrigin: http://evil.example",
        "GET / HTTP/1.1\nHost: 127.0.0.1:{port}\nUpgrade: websocket\nUpgrade: x",
        "GET / HTTP/1.1",
        "HEAD / HTTP/1.1\nHost: 127.0.0.1:{port}",
        "POST / HTTP/1.1\nHost: 127.0.0.1:{port}",
        "CONNECT evil.example:80 HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET http://evil.example/../../../../../../../etc/passwd HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET /%2e%2e/%2e%2e/_viser.py HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET /%252e%252e/_viser.py HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET / HTTP/1.1\nHost: [::1",
        "GET / HTTP/1.1\nHost: 127.0.0.1:{port}\nOrigin: http://[::1",
        "\x16\x03\x01\x02",
    ],
)
def test_odd_requests_are_refused_without_a_traceback(local, request_, caplog):
    answer = reply(local, request_)
    assert answer[:12] in (b"HTTP/1.1 400", b"HTTP/1.1 403", b"HTTP/1.1 404")
    assert not caplog.records


@pytest.mark.parametrize(
    "address", ["//index.html", "http://127.0.0.1/index.html", "/./index.html", "/#/../../etc/passwd"]
)
def test_odd_addresses_of_the_page_are_the_page(local, address, caplog):
    answer = reply(local, f"GET {address} HTTP/1.1\nHost: 127.0.0.1:{{port}}")
    assert answer[:12] == b"HTTP/1.1 200" and b"<html" in answer and not caplog.records


def test_links_in_the_folder_of_the_page_lead_nowhere(tmp_path):
    (tmp_path / "build").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "build" / "link").symlink_to(tmp_path / "secret")
    (tmp_path / "build" / "folder").symlink_to(tmp_path)
    guard = Guard("127.0.0.1", 7007, root=tmp_path / "build")
    assert guard.file("/link") is None and guard.file("/folder/secret") is None


def test_the_page_itself_is_served(local):
    for path in ("/", "/index.html", "/index.html?a=b", "/manifest.json"):
        assert get(local, path).status == 200
    assert b"<html" in get(local, "/").content


def test_the_page_counts_no_visits_and_says_when_it_is_too_narrow(local):
    content = get(local, "/").content
    assert b"googletagmanager" not in content and b"gtag" not in content
    assert b'id="narrow"' in content and b'type="module"' in content


def test_headers_given_twice_do_not_end_in_an_error(local):
    answer = reply(
        local,
        "GET /manifest.json HTTP/1.1\nHost: 127.0.0.1:{port}\nAccept-Encoding: br\nAccept-Encoding: gzip",
    )
    assert answer[:12] == b"HTTP/1.1 200" and b"Content-Encoding: gzip" in answer


# ── origins ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example"])
def test_foreign_host_names_are_refused(local, host):
    assert get(local, "/", host=host or " ").status == 403


@pytest.mark.parametrize("host", ["localhost:{}", "127.0.0.1:{}", "[::1]:{}", "localhost:8000"])
def test_own_names_are_served_tunneled_or_not(local, host):
    host = host.format(local.get_port())
    assert get(local, "/", host=host).status == 200
    assert get(local, "/", host=host, Origin=f"http://{host}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "file://"])
def test_pages_of_other_origins_cannot_connect(local, origin):
    with pytest.raises(InvalidStatus, match="403"):
        page(local, origin=origin)


def test_own_pages_connect(local):
    with page(local) as socket_:
        assert socket_.recv(timeout=10)


# ── a token where others can reach the port ─────────────────────────────────────────────────────────────


def test_beyond_this_machine_nothing_is_served_without_the_token(wide):
    for path in ("/", "/index.html", "/?token=", "/?token=wrong", "/?token=%ff"):
        assert get(wide, path).status == 403
    assert get(wide, "/", Cookie=f"viewer-{wide.get_port()}=wrong").status == 403
    with pytest.raises(InvalidStatus, match="403"):
        page(wide)


def test_the_token_opens_the_page_once_and_leaves_the_address(wide):
    guard = wide._websock_server.guard
    assert guard.address == f"http://localhost:{wide.get_port()}/?token={guard.token}"
    answer = get(wide, f"/?token={guard.token}")
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in answer.headers["Set-Cookie"]
    cookie = {"Cookie": answer.headers["Set-Cookie"].split(";")[0]}
    assert get(wide, "/", **cookie).status == 200
    assert get(wide, "/../../_viser.py", **cookie).status == 404
    with page(wide, additional_headers=cookie) as socket_:
        assert socket_.recv(timeout=10)
    with pytest.raises(InvalidStatus, match="403"):
        page(wide, additional_headers=cookie, origin="http://evil.example")


def test_no_two_viewers_have_one_token(local, wide):
    assert local._websock_server.guard.token != wide._websock_server.guard.token
    assert len(wide._websock_server.guard.token) >= 20


# ── messages ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_a_page_cannot_open_a_tunnel(local, kind):
    with page(local) as socket_:
        tell(socket_, **CAMERA)
        tell(socket_, type=kind)
        assert heard(local, socket_) == []


def test_messages_before_the_first_camera_and_values_of_other_kinds_are_passed_over(local, caplog, capfd):
    with page(local) as socket_:
        set_value(socket_, local, "FPS", value=31.0)
        for bytes_ in (b"", b"\xff", b"\x80", b"\x93\x01", "text"):
            socket_.send(bytes_)
        for message in ({"type": "Nope"}, {"type": 3}, {"type": "GuiUpdateMessage"}, {}):
            tell(socket_, **message)
        time.sleep(0.1)
        tell(socket_, **CAMERA)
        for updates in ({"value": [1, 2]}, {"value": None}, {"label": "x"}, {"nope": 1}, {}, [1], 3):
            tell(socket_, type="GuiUpdateMessage", id=handle_of(local, "FPS")._impl.id, updates=updates)
        for path in (["one"], "none", 3, "two"):
            set_value(socket_, local, "Path", value=path)
        assert heard(local, socket_) == ["two"]
    assert not caplog.records and "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    "name", ["../../../etc/cron", "/tmp/x", "..", "a\x00b", "a\nb; rm -rf /", "", "å b.c"]
)
def test_names_of_files_stay_in_their_folder(local, name, tmp_path):
    with page(local) as socket_:
        tell(socket_, **CAMERA)
        set_value(socket_, local, RENDER_NAME, value=name)
        (taken,) = heard(local, socket_)
    assert taken == file_name(name)
    target = (tmp_path / "camera_paths" / f"{taken}.json").resolve()
    assert target.parent == tmp_path / "camera_paths" and not set(taken) & set("/\\;\n\0$`")


@pytest.mark.parametrize(
    "change",
    [
        {"aspect": 0.0},
        {"aspect": math.nan},
        {"aspect": -1.0},
        {"aspect": math.inf},
        {"fov": 0.0},
        {"fov": math.nan},
        {"fov": 4.0},
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
        {"position": (math.inf, 0.0, 0.0)},
        {"position": (1e30, 0.0, 0.0)},
        {"position": (0.0, 0.0, 0.0)},
        {"up_direction": (0.0, 1.0)},
    ],
)
def test_degenerate_cameras_are_rejected(local, change):
    with page(local) as socket_:
        tell(socket_, **(CAMERA | change))
        time.sleep(0.05)
        assert local.get_clients() == {}  # a client is registered by its first camera
        tell(socket_, **CAMERA)
        for _ in range(500):
            if local.get_clients():
                break
            time.sleep(0.01)
        (client,) = local.get_clients().values()
        assert client.camera.aspect == 1.5
    for _ in range(500):
        if not local.get_clients():
            return
        time.sleep(0.01)
    raise AssertionError("the client is still known")
