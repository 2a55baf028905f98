"""Synonyms from a chat endpoint: a real server on 127.0.0.1, and its failures."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.chat_synonyms import ChatSettings, ChatSynonyms
from lang3dxl_ns.query.text import Prompt, SynonymTable, TextConfig, TextEncoder


class Server(ThreadingHTTPServer):
    """Replies with `reply`: a text for a valid response, or (status, body), after `delay`."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.reply: object = "window, opening"
        self.delay = 0.0
        self.requests: list[tuple[str, dict, dict]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/v1"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.requests.append((self.path, dict(self.headers), body))
        time.sleep(self.server.delay)
        reply = self.server.reply
        if reply == "hang up":
            self.close_connection = True
            return
        proper = json.dumps({"choices": [{"message": {"content": reply}}]})
        status, text = reply if isinstance(reply, tuple) else (200, proper)
        self.send_response(status)
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    server = Server()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def chat(server, tmp_path):
    def make(**changes) -> ChatSynonyms:
        settings = {"url": server.url, "key": "secret", "model": "m", "timeout": 5.0} | changes
        return ChatSynonyms(ChatSettings(cache=tmp_path / "deep" / "cache.json", **settings), SynonymTable())

    return make


def test_an_answer_is_a_list_in_its_order(chat, server):
    server.reply = " gate, 'doorway',  big entrance. "
    assert chat()("portal") == ["gate", "doorway", "big entrance"]
    path, headers, body = server.requests[0]
    assert path == "/v1/chat/completions"
    assert headers["Authorization"] == "Bearer secret"
    assert body["model"] == "m" and body["messages"][-1] == {"role": "user", "content": "portal"}


def test_without_a_key_none_is_sent(chat, server):
    chat(key="")("portal")
    assert "Authorization" not in server.requests[0][1]


def test_none_means_no_synonym(chat, server):
    server.reply = "None."
    assert chat()("portal") == []


def test_answers_are_kept_in_a_file_by_model_and_term(chat, server, tmp_path):
    assert chat()("portal") == chat()("Portal") == ["window", "opening"]
    assert len(server.requests) == 1
    chat(model="other")("portal")
    assert len(server.requests) == 2
    kept = json.loads((tmp_path / "deep" / "cache.json").read_text())
    assert kept == {"m: portal": ["window", "opening"], "other: portal": ["window", "opening"]}


def test_a_damaged_cache_is_made_anew(chat, tmp_path):
    (tmp_path / "deep").mkdir()
    for content in ("{", "[1]"):
        (tmp_path / "deep" / "cache.json").write_text(content)
        assert chat()("portal") == ["window", "opening"]


FAILURES = {
    "500": (500, "oops"),
    "401": (401, "{}"),
    "no JSON": (200, "<html>"),
    "no choices": (200, '{"choices": []}'),
    "another shape": (200, "[1, 2]"),
    "not text": (200, b"\xff\xfe".decode("latin-1")),
    "empty": "",
    "null": (200, '{"choices": [{"message": {"content": null}}]}'),
    "an essay": "Certainly! A portal is a kind of large and often richly decorated entrance to a church.",
    "several lines": "gate\nentrance",
    "holes": "gate,,entrance",
    "hang up": "hang up",
}


@pytest.mark.parametrize("reply", FAILURES.values(), ids=FAILURES)
def test_when_it_fails_the_table_answers_with_a_warning(chat, server, reply, tmp_path):
    server.reply = reply
    with pytest.warns(UserWarning, match="the table answers instead") as warnings:
        assert chat()("lintel") == SynonymTable()("lintel")
    assert "secret" not in str(warnings[0].message)
    assert not (tmp_path / "deep" / "cache.json").exists()
    server.reply = "beam"
    assert chat()("lintel") == ["beam"]  # asked again


def test_a_slow_endpoint_does_not_hold_up_the_query(chat, server):
    server.delay = 1.0
    start = time.perf_counter()
    with pytest.warns(UserWarning, match="the table answers instead"):
        assert chat(timeout=0.1)("lintel") == SynonymTable()("lintel")
    assert time.perf_counter() - start < 0.9


def test_the_table_answers_for_an_unreachable_server(chat):
    with pytest.warns(UserWarning, match="the table answers instead"):
        assert chat(url="http://127.0.0.1:9/v1")("lintel") == SynonymTable()("lintel")


def test_settings_come_from_the_environment(monkeypatch, server, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LANG3DXL_CHAT_URL", server.url)
    monkeypatch.setenv("LANG3DXL_CHAT_MODEL", "small")
    encoder = TextEncoder(lambda texts: torch.ones(len(texts), 4), TextConfig(synonyms="chat"))
    assert encoder.synonyms("porthole") == ["window", "opening"]
    assert (tmp_path / ".cache" / "lang3dxl_ns" / "synonyms.json").exists()
    assert len(encoder.queries([Prompt("porthole")])) == 1 and len(server.requests) == 1


@pytest.mark.parametrize("url", [None, "", "file:///etc/passwd", "localhost:80"])
def test_without_an_address_the_error_says_what_to_set(monkeypatch, url):
    monkeypatch.delenv("LANG3DXL_CHAT_URL", raising=False)
    if url is not None:
        monkeypatch.setenv("LANG3DXL_CHAT_URL", url)
    with pytest.raises(UserError, match="LANG3DXL_CHAT_URL"):
        ChatSettings.from_environment()


def test_the_key_is_not_in_what_gets_printed():
    assert "secret" not in repr(ChatSettings("http://x", "secret"))
