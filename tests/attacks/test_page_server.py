"""Attacks on the server of `lang3dxl view`: files, other origins, host names, odd requests, tokens."""

import contextlib
import http.client
import json
import socket
import threading
import urllib.parse

import pytest
import torch
from painted_scene import painted_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.web import serve
from lang3dxl_ns.query.web.access import Access
from lang3dxl_ns.query.web.serve import PageServer
from lang3dxl_ns.query.web.write_page import Page


@contextlib.contextmanager
def serving():
    server = PageServer(Page(painted_scene(), ["dome"], live=True), port=0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def local():
    with serving() as server:
        yield server


@pytest.fixture(scope="module")
def wide():
    """A server that believes it is open to the network."""
    with serving() as server:
        server.access.host = "0.0.0.0"
        yield server


def get(server, path, host=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    own = f"127.0.0.1:{server.server_port}"
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": own if host is None else host, **headers}.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.content = answer.read()
    connection.close()
    return answer


def reply(server, request) -> bytes:
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=30) as connection:
        connection.sendall(
            (request.format(port=server.server_port) + "\r\nConnection: close\r\n\r\n").encode()
        )
        return b"".join(iter(lambda: connection.recv(65536), b""))


# ── what it serves ──────────────────────────────────────────────────────────────────────────────────────


def test_the_page_is_served_whole(local):
    files = local.files
    for name in ("", *files):
        answer = get(local, f"/{name}")
        assert (answer.status, answer.content) == (200, files[name or "index.html"])
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert get(local, "/index.html?a=b").status == 200
    assert get(local, "/page.js").headers["Content-Type"].startswith("text/javascript")
    assert json.loads(get(local, "/scene.json").content)["live"] is True


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/..%2fserve.py",
        "/serve.py",
        "/__init__.py",
        "//etc/passwd",
        "/index.html/../serve.py",
        "/\\..\\serve.py",
        "http://evil.example/../../etc/passwd",
        "/api",
        "/api/",
        "/api/encode/..",
        "/index.html%00",
    ],
)
def test_nothing_else_is(local, path):
    answer = get(local, path)
    assert answer.status == 404 and b"root:" not in answer.content and b"import" not in answer.content


def test_any_phrase_is_answered_in_the_scenes_numbers(local):
    scene = local.page.scene
    for phrase in ("dome", "some flying saucer", "окно 🙂", '<b>"x"</b>'):
        answer = get(local, f"/api/encode?text={urllib.parse.quote(phrase)}")
        found, queries = (
            json.loads(answer.content),
            scene.text.plain_queries([phrase.replace('"', " ").strip()]),
        )
        cosines = scene.engine.decoded.rows.float() @ torch.tensor(found["own"])
        torch.testing.assert_close(cosines, scene.engine.decoded.cosines(queries)[:, -1], atol=1e-4, rtol=0)
        assert found["against"] == list(queries.negative[0])


@pytest.mark.parametrize("text", ["", "%20", "%22%22", "%00", "%22%20%22"])
def test_an_empty_phrase_is_a_sentence(local, text):
    answer = get(local, f"/api/encode?text={text}")
    assert answer.status == 400 and answer.content.startswith(b"the prompt is empty")


def test_long_and_broken_phrases_are_answered(local):
    assert get(local, "/api/encode?text=" + "x" * 50_000).status == 200
    assert get(local, "/api/encode?text=%ff%fe%ed%a0%80").status == 200
    assert get(local, "/api/encode?text=a;b%22c").status == 200


def test_a_look_of_nobody_is_a_sentence(local):
    answer = get(local, "/api/look?photo=../../etc/passwd")
    assert answer.status == 400 and b"lighting" in answer.content


@pytest.mark.parametrize(
    "request_",
    [
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nHost: evil.example",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\nOrigin: http://x.example",
        "GET / HTTP/1.1\r\nHost: [::1",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://[::1",
        "GET / HTTP/1.1",
        "POST / HTTP/1.1\r\nHost: 127.0.0.1:{port}",
        "HEAD / HTTP/1.1\r\nHost: 127.0.0.1:{port}",
        "CONNECT evil.example:80 HTTP/1.1\r\nHost: 127.0.0.1:{port}",
        "GET http://[::1/ HTTP/1.1\r\nHost: 127.0.0.1:{port}",
        "\x16\x03\x01\x02",
    ],
)
def test_odd_requests_are_refused_without_a_traceback(local, request_, capfd):
    answer = reply(local, request_)
    assert b"200 OK" not in answer[:20] and b"<main>" not in answer
    assert "Traceback" not in capfd.readouterr().err


# ── from whom ───────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example"])
def test_foreign_host_names_are_refused(local, host):
    assert get(local, "/", host=host).status == 403
    assert get(local, "/api/encode?text=x", host=host).status == 403


@pytest.mark.parametrize("host", ["localhost:{}", "127.0.0.1:{}", "[::1]:{}", "localhost:8000"])
def test_own_names_are_served_tunneled_or_not(local, host):
    host = host.format(local.server_port)
    assert get(local, "/", host=host, Origin=f"http://{host}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "file://"])
def test_pages_of_other_origins_are_refused(local, origin):
    assert get(local, "/api/encode?text=x", Origin=origin).status == 403


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
    for path in ("/", "/page.js", "/api/encode?text=x", "/?token=", "/?token=wrong", "/?token=%ff"):
        assert get(wide, path).status == 403
    assert get(wide, "/", Cookie=f"viewer-{wide.server_port}=wrong").status == 403
    assert get(wide, "/", Cookie="viewer=\x80;;=").status == 403


def test_the_token_opens_the_page_once_and_leaves_the_address(wide):
    access = wide.access
    assert access.address == f"http://localhost:{wide.server_port}/?token={access.token}"
    answer = get(wide, f"/?token={access.token}")
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    assert "HttpOnly" in answer.headers["Set-Cookie"]
    cookie = {"Cookie": answer.headers["Set-Cookie"].split(";")[0]}
    assert get(wide, "/page.js", **cookie).status == 200
    assert get(wide, "/page.js", Origin="http://evil.example", **cookie).status == 403


def test_no_two_servers_have_one_token(local, wide):
    assert local.access.token != wide.access.token and len(wide.access.token) >= 20


# ── where ───────────────────────────────────────────────────────────────────────────────────────────────


def test_a_taken_port_is_a_sentence_and_a_free_one_is_found(local, monkeypatch):
    page = local.page
    with pytest.raises(UserError, match=f"port {local.server_port} of 127.0.0.1"):
        PageServer(page, port=local.server_port)
    monkeypatch.setattr(serve, "FIRST_PORT", local.server_port)
    other = PageServer(page)
    assert other.server_port != local.server_port
    other.server_close()
    for host, port in (("203.0.113.7", None), ("127.0.0.1", 70_000), ("no such host.invalid", 0)):
        with pytest.raises(UserError, match="choose another"):
            PageServer(page, host, port)
