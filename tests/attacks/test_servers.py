"""Attacks on the servers of `lang3dxl view` and of nerfstudio's viewer: files, other origins, host names, odd
requests, tokens, share tunnels, broken messages."""

import contextlib
import http.client
import json
import math
import socket
import struct
import threading
import time
import urllib.parse

import msgspec
import pytest
import torch
import viser
from painted_scene import painted_scene
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.viewer_guard import RENDER_NAME, Guard, file_name, guard_viewers
from lang3dxl_ns.web import serve
from lang3dxl_ns.web.access import Access
from lang3dxl_ns.web.serve import PageServer
from lang3dxl_ns.web.write_page import Page

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
def page_server():
    server = PageServer(Page(painted_scene(), ["dome"], live=True), port=0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    server.port = server.server_port
    yield server
    server.shutdown()
    server.server_close()


@contextlib.contextmanager
def viewer_server():
    """A viewer's server, started by nerfstudio from our pipeline."""
    guard_viewers()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    server.port, server.access, server.seen = server.get_port(), server._websock_server.guard, []
    server.gui.add_slider("FPS", 1.0, 240.0, 1.0, 30.0).on_update(
        lambda e: server.seen.append(e.target.value)
    )
    server.gui.add_text(RENDER_NAME, "a").on_update(lambda e: server.seen.append(e.target.value))
    server.gui.add_dropdown("Path", ("one", "two")).on_update(lambda e: server.seen.append(e.target.value))
    server.request_share_url = lambda *_: server.seen.append("shared")
    yield server
    server.stop()


KINDS = {"page": page_server, "viewer": viewer_server}


@pytest.fixture(scope="module", params=KINDS)
def server(request):
    with KINDS[request.param]() as server:
        yield server


@pytest.fixture(scope="module", params=KINDS)
def wide(request):
    """A server that believes it is open to the network."""
    with KINDS[request.param]() as server:
        server.access.host = "0.0.0.0"
        yield server


@pytest.fixture(scope="module")
def page():
    with page_server() as server:
        yield server


@pytest.fixture(scope="module")
def viewer():
    with viewer_server() as server:
        yield server


def get(server, path, host=None, **headers):
    """The response to a path sent verbatim."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", f"127.0.0.1:{server.port}" if host is None else host)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.content = answer.read()
    connection.close()
    return answer


def reply(server, request) -> bytes:
    """What comes back for a request that no client library would send."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as raw:
        lines = f"{request.format(port=server.port)}\nConnection: close\n\n"
        raw.sendall(lines.replace("\n", "\r\n").encode())
        return b"".join(iter(lambda: raw.recv(1 << 16), b""))


def session(server, **options):
    """A page's websocket."""
    options = {"origin": f"http://127.0.0.1:{server.port}", "open_timeout": 10, **options}
    return connect(f"ws://127.0.0.1:{server.port}", **options)


# ── what both servers refuse ────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../../../../../etc/passwd",
        "/assets/../../../../../../../../../../../etc/passwd",
        "//etc/passwd",
        "/./../build/../../_viser.py",
        "/%2e%2e/%2e%2e/_viser.py",
        "/..%2fserve.py",
        "/serve.py",
        "/assets",
        "/\\..\\..",
        "/index.html/../serve.py",
        "/" + "a" * 3000,
        "http:///etc/passwd",
        "http://evil.example/../../etc/passwd",
        "/api",
        "/api/encode/..",
        "*",
        "/a%00b",
    ],
)
def test_only_files_of_the_page_are_served(server, path):
    answer = get(server, path)
    assert answer.status in (403, 404)
    assert b"root:" not in answer.content and b"import" not in answer.content


ADDRESSED = "GET / HTTP/1.1\nHost: 127.0.0.1:{port}"


@pytest.mark.parametrize(
    "request_",
    [
        f"{ADDRESSED}\nHost: evil.example",
        f"{ADDRESSED}\nOrigin: http://127.0.0.1:{{port}}\nOrigin: http://evil.example",
        f"{ADDRESSED}\nOrigin: http://[::1",
        "GET / HTTP/1.1\nHost: [::1",
        "GET / HTTP/1.1",
        "HEAD / HTTP/1.1\nHost: 127.0.0.1:{port}",
        "POST / HTTP/1.1\nHost: 127.0.0.1:{port}",
        "CONNECT evil.example:80 HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET http://evil.example/../../../../../../../etc/passwd HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET http://[::1/ HTTP/1.1\nHost: 127.0.0.1:{port}",
        "GET /%252e%252e/_viser.py HTTP/1.1\nHost: 127.0.0.1:{port}",
        "\x16\x03\x01\x02",
    ],
)
def test_odd_requests_are_refused_without_a_traceback(server, request_, capfd, caplog):
    answer = reply(server, request_)
    assert b"200 OK" not in answer[:20] and b"<main>" not in answer and b"root:" not in answer
    assert "Traceback" not in capfd.readouterr().err and not caplog.records


def test_a_connection_that_breaks_off_leaves_no_traceback(page, capfd):
    for sent in (
        b"",
        b"GET / HTTP/1.1\r\n",
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode(),
    ):
        raw = socket.create_connection(("127.0.0.1", page.port))
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close with a reset
        raw.sendall(sent)
        time.sleep(0.2)
        raw.close()
    time.sleep(0.5)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", " ", "127.0.0.1.evil.example"])
def test_foreign_host_names_are_refused(server, host):
    assert get(server, "/", host=host).status == 403
    assert get(server, "/api/encode?text=x", host=host).status == 403


@pytest.mark.parametrize("host", ["localhost:{}", "127.0.0.1:{}", "[::1]:{}", "localhost:8000"])
def test_own_names_are_served_tunneled_or_not(server, host):
    host = host.format(server.port)
    assert get(server, "/", host=host).status == 200
    assert get(server, "/", host=host, Origin=f"http://{host}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "file://"])
def test_pages_of_other_origins_are_refused(server, origin):
    assert get(server, "/api/encode?text=x", Origin=origin).status == 403
    with pytest.raises(InvalidStatus, match="403"):
        session(server, origin=origin)


def test_other_sites_may_link_here_and_not_embed_this_server(server):
    embedded = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}
    assert get(server, "/api/encode?text=x", **embedded).status == 403
    assert get(server, "/", **(embedded | {"Sec-Fetch-Mode": "navigate"})).status == 200
    assert get(server, "/", **(embedded | {"Sec-Fetch-Site": "same-origin"})).status == 200


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_this_machine_alone_needs_no_token(host):
    access = Access(host, 7007)
    assert not access.needs_token and access.address.endswith(":7007/")
    access.public = True
    assert access.needs_token and access.token in access.address


@pytest.mark.parametrize("host", ["0.0.0.0", "", "::", "192.168.1.5", "my-machine", "128.0.0.1"])
def test_a_host_open_to_others_needs_a_token(host):
    assert Access(host, 7007).needs_token


def test_beyond_this_machine_nothing_is_served_without_the_token(wide):
    for path in ("/", "/index.html", "/api/encode?text=x", "/?token=", "/?token=wrong", "/?token=%ff"):
        assert get(wide, path).status == 403
    assert get(wide, "/", Cookie=f"viewer-{wide.port}=wrong").status == 403
    with contextlib.suppress(http.client.RemoteDisconnected):  # so websockets 16.1 answers such a header
        assert get(wide, "/", Cookie="viewer=\x80;;=").status == 403
    with pytest.raises(InvalidStatus, match="403"):
        session(wide)


def test_the_token_opens_the_page_once_and_leaves_the_address(wide):
    access = wide.access
    assert access.address == f"http://localhost:{wide.port}/?token={access.token}"
    answer = get(wide, f"/?token={access.token}")
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in answer.headers["Set-Cookie"]
    # A link that is clicked in a chat on the web opens the page, and Strict would not.
    assert "SameSite=Lax" in answer.headers["Set-Cookie"]
    cookie = {"Cookie": answer.headers["Set-Cookie"].split(";")[0]}
    assert get(wide, "/", **cookie).status == 200
    assert get(wide, "/../../_viser.py", **cookie).status == 404
    assert get(wide, "/", Origin="http://evil.example", **cookie).status == 403


def test_no_two_servers_have_one_token(server, wide):
    assert server.access.token != wide.access.token and len(wide.access.token) >= 20


# ── the page ────────────────────────────────────────────────────────────────────────────────────────────


def test_the_page_is_served_whole(page):
    files = page.files
    for name in ("", *files):
        answer = get(page, f"/{name}")
        assert (answer.status, answer.content) == (200, files[name or "index.html"])
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert get(page, "/index.html?a=b").status == 200
    assert get(page, "/page.js").headers["Content-Type"].startswith("text/javascript")
    assert json.loads(get(page, "/scene.json").content)["live"] is True


def test_any_phrase_is_answered_in_the_scenes_numbers(page):
    scene = page.page.scene
    for phrase in ("dome", "some flying saucer", "окно 🙂", '<b>"x"</b>'):
        answer = get(page, f"/api/encode?text={urllib.parse.quote(phrase)}")
        found, queries = (
            json.loads(answer.content),
            scene.text.plain_queries([phrase.replace('"', " ").strip()]),
        )
        cosines = scene.engine.rows.float() @ torch.tensor(found["own"])
        torch.testing.assert_close(cosines, scene.engine.cosines(queries)[:, -1], atol=1e-4, rtol=0)
        assert found["against"] == list(queries.negative[0])


@pytest.mark.parametrize("text", ["", "%20", "%22%22", "%00", "%22%20%22"])
def test_an_empty_phrase_is_a_sentence(page, text):
    answer = get(page, f"/api/encode?text={text}")
    assert answer.status == 400 and answer.content.startswith(b"the prompt is empty")


def test_long_and_broken_phrases_are_answered(page):
    assert get(page, "/api/encode?text=" + "x" * 50_000).status == 200
    assert get(page, "/api/encode?text=%ff%fe%ed%a0%80").status == 200
    assert get(page, "/api/encode?text=a;b%22c").status == 200


def test_a_look_of_nobody_is_a_sentence(page):
    answer = get(page, "/api/look?photo=../../etc/passwd")
    assert answer.status == 400 and b"lighting" in answer.content


def test_a_taken_port_is_a_sentence_and_a_free_one_is_found(page, monkeypatch):
    with pytest.raises(UserError, match=f"port {page.port} of 127.0.0.1"):
        PageServer(page.page, port=page.port)
    monkeypatch.setattr(serve, "FIRST_PORT", page.port)
    other = PageServer(page.page)
    assert other.server_port != page.port
    other.server_close()
    for host, port in (("203.0.113.7", None), ("127.0.0.1", 70_000), ("no such host.invalid", 0)):
        with pytest.raises(UserError, match="choose another"):
            PageServer(page.page, host, port)


# ── nerfstudio's viewer ─────────────────────────────────────────────────────────────────────────────────


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


@pytest.mark.parametrize("upgrade", ["WebSocket", "WEBSOCKET", "websocket", "websocket, x", "h2c", ""])
@pytest.mark.parametrize("name", ["etc/passwd", "proc/self/environ"])
def test_no_file_is_served_as_the_handshake_of_a_websocket(viewer, upgrade, name):
    answer = get(viewer, f"/../../../../../../../../../../{name}", Upgrade=upgrade, Connection="Upgrade")
    assert answer.status >= 400 and b"root:" not in answer.content and b"PATH=" not in answer.content


@pytest.mark.parametrize(
    "address", ["//index.html", "http://127.0.0.1/index.html", "/./index.html", "/#/../../etc/passwd"]
)
def test_odd_addresses_of_the_page_are_the_page(viewer, address, caplog):
    answer = reply(viewer, f"GET {address} HTTP/1.1\nHost: 127.0.0.1:{{port}}")
    assert answer[:12] == b"HTTP/1.1 200" and b"<html" in answer and not caplog.records


def test_links_in_the_folder_of_the_page_lead_nowhere(tmp_path):
    (tmp_path / "build").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "build" / "link").symlink_to(tmp_path / "secret")
    (tmp_path / "build" / "folder").symlink_to(tmp_path)
    guard = Guard("127.0.0.1", 7007, root=tmp_path / "build")
    assert guard.file("/link") is None and guard.file("/folder/secret") is None


def test_the_page_itself_is_served(viewer):
    for path in ("/", "/index.html", "/index.html?a=b", "/manifest.json"):
        assert get(viewer, path).status == 200
    assert b"<html" in get(viewer, "/").content


def test_the_page_counts_no_visits_and_says_when_it_is_too_narrow(viewer):
    content = get(viewer, "/").content
    assert b"googletagmanager" not in content and b"gtag" not in content
    assert b'id="narrow"' in content and b'type="module"' in content


def test_headers_given_twice_do_not_end_in_an_error(viewer):
    asked = "GET /manifest.json HTTP/1.1\nHost: 127.0.0.1:{port}\n"
    answer = reply(viewer, f"{asked}Accept-Encoding: br\nAccept-Encoding: gzip")
    assert answer[:12] == b"HTTP/1.1 200" and b"Content-Encoding: gzip" in answer
    assert reply(viewer, f"{asked}Upgrade: websocket\nUpgrade: x")[:12] == b"HTTP/1.1 404"


def test_an_own_page_connects(viewer):
    with session(viewer) as socket_:
        assert socket_.recv(timeout=10)


@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_a_page_cannot_open_a_tunnel(viewer, kind):
    with session(viewer) as socket_:
        tell(socket_, **CAMERA)
        tell(socket_, type=kind)
        assert heard(viewer, socket_) == []


def test_messages_before_the_first_camera_and_values_of_other_kinds_are_passed_over(viewer, caplog, capfd):
    with session(viewer) as socket_:
        set_value(socket_, viewer, "FPS", value=31.0)
        for bytes_ in (b"", b"\xff", b"\x80", b"\x93\x01", "text"):
            socket_.send(bytes_)
        for message in ({"type": "Nope"}, {"type": 3}, {"type": "GuiUpdateMessage"}, {}):
            tell(socket_, **message)
        time.sleep(0.1)
        tell(socket_, **CAMERA)
        for updates in ({"value": [1, 2]}, {"value": None}, {"label": "x"}, {"nope": 1}, {}, [1], 3):
            tell(socket_, type="GuiUpdateMessage", id=handle_of(viewer, "FPS")._impl.id, updates=updates)
        for path in (["one"], "none", 3, "two"):
            set_value(socket_, viewer, "Path", value=path)
        assert heard(viewer, socket_) == ["two"]
    assert not caplog.records and "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    "name", ["../../../etc/cron", "/tmp/x", "..", "a\x00b", "a\nb; rm -rf /", "", "å b.c"]
)
def test_names_of_files_stay_in_their_folder(viewer, name, tmp_path):
    with session(viewer) as socket_:
        tell(socket_, **CAMERA)
        set_value(socket_, viewer, RENDER_NAME, value=name)
        (taken,) = heard(viewer, socket_)
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
def test_degenerate_cameras_are_rejected(viewer, change):
    with session(viewer) as socket_:
        tell(socket_, **(CAMERA | change))
        time.sleep(0.05)
        assert viewer.get_clients() == {}  # a client is registered by its first camera
        tell(socket_, **CAMERA)
        for _ in range(500):
            if viewer.get_clients():
                break
            time.sleep(0.01)
        (client,) = viewer.get_clients().values()
        assert client.camera.aspect == 1.5
    for _ in range(500):
        if not viewer.get_clients():
            return
        time.sleep(0.01)
    raise AssertionError("the client is still known")
