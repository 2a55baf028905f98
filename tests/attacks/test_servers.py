"""Attacks on the server of `lang3dxl view`: files, other origins, host names, odd requests, tokens."""

import contextlib
import json
import socket
import struct
import threading
import time
import urllib.parse
from http import HTTPStatus
from types import SimpleNamespace

import pytest
import torch
from painted_scene import painted_scene
from raw_http import get, reply

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.web import serve
from lang3dxl_ns.web.access import Access
from lang3dxl_ns.web.serve import PageServer
from lang3dxl_ns.web.write_page import Page


@contextlib.contextmanager
def page_server():
    server = PageServer(Page(painted_scene(), ["dome"], live=True), port=0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    server.port = server.server_port
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def page():
    with page_server() as server:
        yield server


@pytest.fixture(scope="module")
def wide():
    """A server that believes it is open to the network."""
    with page_server() as server:
        server.access.host = "0.0.0.0"
        yield server


def test_each_part_of_a_file_is_sent_with_a_patience_of_its_own():
    content, parts, handler = bytes(range(256)) * 2000, [], serve.Handler.__new__(serve.Handler)
    handler.wfile = SimpleNamespace(write=parts.append)
    handler.request_version, handler.requestline = "HTTP/1.1", "GET /views.bin HTTP/1.1"
    handler._send(HTTPStatus.OK, {}, content)
    assert b"".join(parts).endswith(b"\r\n\r\n" + content)
    assert max(map(len, parts)) <= 1 << 16


# ── what it refuses ────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../../../../../../../etc/passwd",
        "/assets/../../../../../../../../../../../etc/passwd",
        "//etc/passwd",
        "/./../build/../../serve.py",
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
def test_only_files_of_the_page_are_served(page, path):
    answer = get(page, path)
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
def test_odd_requests_are_refused_without_a_traceback(page, request_, capfd, caplog):
    answer = reply(page, request_)
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
def test_foreign_host_names_are_refused(page, host):
    assert get(page, "/", host=host).status == 403
    assert get(page, "/api/encode?text=x", host=host).status == 403


@pytest.mark.parametrize("host", ["localhost:{}", "127.0.0.1:{}", "[::1]:{}", "localhost:8000"])
def test_own_names_are_served_tunneled_or_not(page, host):
    host = host.format(page.port)
    assert get(page, "/", host=host).status == 200
    assert get(page, "/", host=host, Origin=f"http://{host}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "file://"])
def test_pages_of_other_origins_are_refused(page, origin):
    assert get(page, "/api/encode?text=x", Origin=origin).status == 403


def test_other_sites_may_link_here_and_not_embed_this_server(page):
    embedded = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}
    assert get(page, "/api/encode?text=x", **embedded).status == 403
    assert get(page, "/", **(embedded | {"Sec-Fetch-Mode": "navigate"})).status == 200
    assert get(page, "/", **(embedded | {"Sec-Fetch-Site": "same-origin"})).status == 200


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_this_machine_alone_needs_no_token(host):
    access = Access(host, 7007)
    assert not access.needs_token and access.address.endswith(":7007/")


def test_a_server_at_all_addresses_names_one_for_other_machines():
    access = Access("0.0.0.0", 7007)
    assert "localhost" in access.address and access.elsewhere is not None
    assert urllib.parse.urlsplit(access.elsewhere).hostname not in ("0.0.0.0", "localhost", "127.0.0.1")
    assert access.elsewhere.endswith(f":7007/?token={access.token}")
    assert Access("192.168.1.5", 7007).elsewhere is None


@pytest.mark.parametrize("host", ["0.0.0.0", "", "::", "192.168.1.5", "my-machine", "128.0.0.1"])
def test_a_host_open_to_others_needs_a_token(host):
    assert Access(host, 7007).needs_token


def test_beyond_this_machine_nothing_is_served_without_the_token(wide):
    for path in ("/", "/index.html", "/api/encode?text=x", "/?token=", "/?token=wrong", "/?token=%ff"):
        assert get(wide, path).status == 403
    assert get(wide, "/", Cookie=f"viewer-{wide.port}=wrong").status == 403
    assert get(wide, "/", Cookie="viewer=\x80;;=").status == 403


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
    assert get(wide, "/../../serve.py", **cookie).status == 404
    assert get(wide, "/", Origin="http://evil.example", **cookie).status == 403


def test_no_two_servers_have_one_token(page, wide):
    assert page.access.token != wide.access.token and len(wide.access.token) >= 20


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


def test_the_body_of_a_get_is_no_second_request(page):
    """A proxy would take its answer for that to somebody else's request."""
    second = "GET /scene.json HTTP/1.1\nHost: 127.0.0.1:{port}\n"
    for length in ("Content-Length: 70", "Transfer-Encoding: chunked"):
        with socket.create_connection(("127.0.0.1", page.port), timeout=30) as raw:
            first = f"GET /page.css HTTP/1.1\nHost: 127.0.0.1:{{port}}\n{length}\n\n{second}\n"
            raw.sendall(first.format(port=page.port).replace("\n", "\r\n").encode())
            answers = b"".join(iter(lambda: raw.recv(1 << 16), b""))
        assert answers.count(b"HTTP/1.1 ") == 1 and answers.startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize("point", ["1e999", "NaN", "9" * 400, "1e300"])
def test_numbers_that_are_none_are_no_marks(page, point):
    """Python's float and int raise an OverflowError for some, which is no ValueError."""
    marks = (
        f'"points": [[{point}, 1]]',
        f'"points": [], "mask": {{"size": [{point}, 2], "counts": [1]}}',
        f'"points": [], "box": [{point}, 0, 1, 1]',
    )
    for marked in marks:
        example = f'{{"photo": "left/0001.jpg", "not_points": [], {marked}}}'
        body = f'{{"name": "gate", "before": "", "examples": [{example}]}}'
        assert posted(page, body, len(body)).startswith(b"HTTP/1.1 400"), marked


@pytest.mark.parametrize("length", ["abc", "-5", "1e3", "0", "99999999999"])
def test_what_is_not_read_of_a_post_is_not_another_request(page, length):
    """Otherwise what one sends after it would pass for a request of the page's own."""
    smuggled = f"GET / HTTP/1.1\r\nHost: localhost:{page.port}\r\nConnection: close\r\n\r\n"
    assert b"HTTP/1.1 200" not in posted(page, smuggled, length)


def posted(server, body: str, length: object) -> bytes:
    """The answers to a POST from the server's own page, until it closes the connection."""
    head = f"POST /api/teach HTTP/1.1\r\nHost: localhost:{server.port}\r\nContent-Length: {length}\r\n"
    head += f"Origin: http://localhost:{server.port}\r\nContent-Type: application/json\r\n\r\n"
    answers = b""
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as raw:
        raw.sendall((head + body).encode())
        with contextlib.suppress(ConnectionError):  # it closes before it has read all
            while part := raw.recv(1 << 16):
                answers += part
    return answers
