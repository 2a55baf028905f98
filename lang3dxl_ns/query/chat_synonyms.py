"""Synonyms from a chat model behind an OpenAI-compatible endpoint; off by default."""

from __future__ import annotations

import json
import os
import urllib.request
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import write_atomically

_QUESTION = (
    "You help to find parts of buildings in photos. List up to five synonyms of the given term that are at "
    "least as common as the term itself, from most to least common, separated by commas, on one line and "
    "without any other text. If there is none, answer with the single word none."
)
_MOST_WORDS, _LONGEST_ANSWER = 6, 300
_MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class ChatSettings:
    """Endpoint of the chat model, and the file of its answers."""

    url: str
    """Base URL, such as http://127.0.0.1:8080/v1."""
    key: str = field(default="", repr=False)
    """Sent as bearer token, if any."""
    model: str = "default"
    """Name of the model at the endpoint."""
    timeout: float = 10.0
    """Time limit in seconds, after which the table is used instead."""
    cache: Path = Path("~/.cache/lang3dxl_ns/synonyms.json")
    """Answers so far, by model and term."""

    @classmethod
    def from_environment(cls) -> ChatSettings:
        """LANG3DXL_CHAT_URL, LANG3DXL_CHAT_KEY, LANG3DXL_CHAT_MODEL. Raises UserError without a URL."""
        url = os.environ.get("LANG3DXL_CHAT_URL")
        if not url or not url.startswith(("http://", "https://")):
            raise UserError(
                f"synonyms should come from a chat model, but LANG3DXL_CHAT_URL is {url or 'not set'}: set "
                f"it to the base URL of an OpenAI-compatible endpoint, such as http://127.0.0.1:8080/v1"
            )
        key, model = os.environ.get("LANG3DXL_CHAT_KEY", ""), os.environ.get("LANG3DXL_CHAT_MODEL", "default")
        return cls(url, key, model)


class ChatSynonyms:
    """Asks once per term; any failure is a warning, and `fallback` answers instead."""

    def __init__(self, settings: ChatSettings, fallback: Callable[[str], list[str]]) -> None:
        self.settings = settings
        self._fallback = fallback
        self._path = settings.cache.expanduser()

    def __call__(self, text: str) -> list[str]:
        """Synonyms of a term, most common first."""
        cache = self._read_cache()
        entry = f"{self.settings.model}: {text.lower()}"
        if entry not in cache:
            try:
                cache[entry] = _parse_answer(self._ask(text))
            except (
                OSError,
                ValueError,
                HTTPException,
            ) as error:  # URLError, time-outs: OSError; JSON: ValueError
                reason = f"{type(error).__name__}: {error}"
                warnings.warn(
                    f"no synonyms of {text!r} from {self.settings.url} ({reason}): the table answers instead",
                    stacklevel=2,
                )
                return self._fallback(text)
            write_atomically(self._path, json.dumps(cache, indent=1, ensure_ascii=False) + "\n")
        return cache[entry]

    def _ask(self, text: str) -> str:
        messages = [{"role": "system", "content": _QUESTION}, {"role": "user", "content": text}]
        body = {"model": self.settings.model, "messages": messages, "temperature": 0}
        headers = {"Content-Type": "application/json"}
        if self.settings.key:
            headers["Authorization"] = f"Bearer {self.settings.key}"
        address = f"{self.settings.url.rstrip('/')}/chat/completions"
        request = urllib.request.Request(address, json.dumps(body).encode(), headers)
        with urllib.request.urlopen(request, timeout=self.settings.timeout) as response:
            answer = json.loads(response.read(_MOST_BYTES))
        try:
            return str(answer["choices"][0]["message"]["content"] or "")
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"the answer has no choices[0].message.content ({error!r})") from error

    def _read_cache(self) -> dict[str, list[str]]:
        try:
            cache = json.loads(self._path.read_text())
        except (OSError, ValueError):
            return {}
        return cache if isinstance(cache, dict) else {}


def _parse_answer(content: str) -> list[str]:
    """The synonyms in an answer. Raises ValueError if it isn't a list of short phrases."""
    content = content.strip().strip(".")
    if not content:
        raise ValueError("the answer is empty")
    if content.lower() == "none":
        return []
    words = [word.strip(" \"'") for word in content.split(",")]
    is_list = "\n" not in content and len(content) <= _LONGEST_ANSWER
    if not is_list or not all(word and len(word.split()) <= _MOST_WORDS for word in words):
        raise ValueError(f"the answer is not a list of synonyms: {content[:60]!r}")
    return words
