"""What people type: golden cases, read alike by Python and by the page's JavaScript."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from lang3dxl_ns import web
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.language import TABLE, meaning
from lang3dxl_ns.query.text import caution, parse_prompts, taught_prompt
from lang3dxl_ns.query.vocabulary import closest_word, common_words, shipped_vocabulary
from lang3dxl_ns.web.write_page import language_module

READ = """
import { meaning, parsePrompts } from "./vocabulary.js";
import cases from "./cases.js";
const read = (case_) => parsePrompts(...case_).map(({ text, negatives }) => {
  const { target, unused } = meaning(text);
  return [text, negatives, target, unused.map(([kind]) => kind)];
});
console.log(JSON.stringify(cases.map((case_) => {
  try { return read(case_); } catch (error) { return error.message; }
})));
"""


NAMES = ("lords and ladies", "do not enter gate", "Mary, Queen (of Scots)", "Tu\u0308rme und Tore")
"""Names of taught words that hold separators, one with its accent behind the letter."""
NAMED = {
    "windows and lords and ladies": ["windows", "lords and ladies"],
    "Lords and Ladies, doors": ["Lords and Ladies", "doors"],
    "do not enter gate; mary, queen (of scots)": ["do not enter gate", "mary, queen (of scots)"],
    "overlords and ladies": ["overlords", "ladies"],
    "Türme und Tore": ["Türme und Tore"],
}


def read(typed: str, names=()) -> list | str:
    """What Python makes of a text, in the form of the table's cases, or says against it."""
    try:
        meanings = [(prompt, meaning(prompt.text)) for prompt in parse_prompts(typed, names)]
    except UserError as error:
        return str(error)
    return [[p.text, list(p.negatives), m.target, [kind for kind, _ in m.unused]] for p, m in meanings]


@pytest.mark.parametrize(("typed", "expected"), TABLE["cases"])
def test_what_people_type_is_read_as_meant(typed, expected):
    assert read(typed) == expected


@pytest.mark.parametrize(("typed", "expected"), NAMED.items())
def test_a_name_is_never_split(typed, expected):
    assert [prompt.text for prompt in parse_prompts(typed, NAMES)] == expected
    assert not any(prompt.negatives for prompt in parse_prompts(typed, NAMES))


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_page_reads_the_same(tmp_path):
    for path in Path(web.__file__).parent.glob("*.js"):
        shutil.copy(path, tmp_path)
    (tmp_path / "language.js").write_bytes(language_module())
    typed = [(case[0], ()) for case in TABLE["cases"]] + [(word, ()) for word in common_words()]
    typed += [("not doors", ()), ("windows; without “arches”, doors", ())]  # only negatives
    typed += [(text, NAMES) for text in (*NAMED, *(case[0] for case in TABLE["cases"]))]
    (tmp_path / "cases.js").write_text(f"export default {json.dumps(typed)};")
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "read.mjs").write_text(READ)
    done = subprocess.run(["node", tmp_path / "read.mjs"], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [read(*one) for one in typed]


def test_every_word_that_is_shipped_is_one_prompt_for_itself():
    for word in shipped_vocabulary():
        (prompt,) = parse_prompts(word)
        assert prompt.text == word and not prompt.negatives


def test_an_unused_part_is_told_with_what_is_searched_for():
    assert "door is searched for everywhere" in caution("the big door on the left")
    assert "all windows are shown" in caution("how many windows are there?")
    assert caution("rose window") is None


def test_a_taught_name_may_hold_any_separator():
    assert taught_prompt("doors and windows, not gates").text == "doors and windows, not gates"


@pytest.mark.parametrize(("typed", "meant"), [("windwos", "windows"), ("windows", None), ("xqzzy", None)])
def test_a_misspelling_gets_a_suggestion_and_a_word_gets_none(typed, meant):
    assert closest_word(typed, common_words()) == meant
