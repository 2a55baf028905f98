"""Parsing of prompts, synonyms, and text vectors."""

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.text import Prompt, TextConfig, TextEncoder, caution, listed_phrases, parse_prompts
from lang3dxl_ns.query.vocabulary import (
    common_words,
    searched,
    shipped_vocabulary,
    synonym_table,
    synonyms_of,
)


def test_a_scene_file_knows_what_its_words_are_searched_as():
    """The page asks for all of them, and has to be written without the CLIP too."""
    assert {searched(word) for word in shipped_vocabulary()} <= set(common_words())


def test_a_prompt_longer_than_clip_reads_is_said_to_be():
    assert "the rest of this prompt is ignored" in caution("sky " * 60 + "rose window")
    assert caution("a tower with four clocks and a bell") is None


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("rose window", [Prompt("rose window")]),
        ("a; b ;; c;", [Prompt("a"), Prompt("b"), Prompt("c")]),
        ("  many\n\tspaces  ", [Prompt("many spaces")]),
        ('"windows" not "decorative opening"', [Prompt("windows", ("decorative opening",))]),
        ("“windows” not „arcades“", [Prompt("windows", ("arcades",))]),
        ('"door; open" not "a; b"', [Prompt("door; open", ("a; b",))]),
        ("do not enter sign", [Prompt("do not enter sign")]),
        ('knot "garden"', [Prompt("knot garden")]),
        ('a "quote that never ends', [Prompt("a quote that never ends")]),
        ('dome not ""', [Prompt("dome")]),
        ("🙂; окно; 窓", [Prompt("🙂"), Prompt("окно"), Prompt("窓")]),
        ("half a\ud800 pair", [Prompt("half a pair")]),
    ],
)
def test_prompts_are_read_as_typed(typed, expected):
    assert parse_prompts(typed) == expected


@pytest.mark.parametrize("typed", ["", "   ", ";;", '""', '" "; ', "\0", "\ud800"])
def test_an_empty_prompt_is_refused_in_words(typed):
    with pytest.raises(UserError, match="the prompt is empty: type what to look for"):
        parse_prompts(typed)


def test_negatives_alone_are_refused_in_words():
    with pytest.raises(UserError, match="only negatives"):
        parse_prompts('not "doors"')


def test_the_table_holds_architectural_terms_with_common_synonyms():
    terms = synonym_table()
    assert len(terms) >= 60
    for term, synonyms in terms.items():
        assert term == term.lower().strip() and isinstance(synonyms, list) and synonyms, term
        assert all(isinstance(s, str) and s == s.strip() and "," not in s for s in synonyms), term
        assert term not in synonyms and len(set(synonyms)) == len(synonyms), term
    assert {"pinnacle", "lintel", "archivolt", "minaret", "muqarnas", "pendentive"} <= set(terms)


@pytest.mark.parametrize("text", ["lintel", "Lintels", "the LINTEL", " a lintel "])
def test_terms_are_known_in_singular_and_plural(text):
    assert synonyms_of(text)[0] == "beam above a door"


@pytest.mark.parametrize(
    ("plural", "term"),
    [("niches", "niche"), ("balconies", None), ("buttresses", "buttress"), ("apses", "apse"),
     ("oculi", "oculus"), ("tympana", "tympanum"), ("niche", "niche"), ("basilica", None)],
)  # fmt: skip
def test_plurals_of_several_kinds(plural, term):
    assert synonyms_of(plural) == (synonym_table()[term] if term else [])


@pytest.fixture
def encode():
    """A deterministic vector per text; counts the calls."""
    asked = []

    def run(texts):
        asked.extend(texts)
        seeds = [sum(text.encode()) for text in texts]
        return torch.stack([torch.randn(16, generator=torch.Generator().manual_seed(s)) for s in seeds])

    run.asked = asked
    return run


def rows(encoder: TextEncoder, text: str) -> torch.Tensor:
    queries = encoder.queries([Prompt(text)])
    return queries.vectors[list(queries.positive[0])]


def test_synonyms_are_joined_or_each_on_its_own(encode):
    words = [*synonyms_of("oculus"), "oculus"]
    joined, each = (
        rows(TextEncoder(encode, TextConfig(combine=c)), "oculus") for c in ("joined", "fallback")
    )
    unit = torch.nn.functional.normalize(encode(words), dim=1)
    torch.testing.assert_close(each, unit)
    torch.testing.assert_close(joined, torch.nn.functional.normalize(encode([", ".join(words)]), dim=1))


def test_without_synonyms_a_term_stands_alone(encode):
    encoder = TextEncoder(encode, TextConfig(synonyms="off"))
    assert encoder.synonyms("oculus") == []
    rows(encoder, "oculus")
    assert "oculus" in encode.asked and "round window" not in "".join(encode.asked)


@pytest.mark.parametrize("combine", ["joined", "fallback"])
def test_a_common_word_is_the_same_however_synonyms_are_combined(encode, combine):
    expected = torch.nn.functional.normalize(encode(["window"]), dim=1)
    torch.testing.assert_close(rows(TextEncoder(encode, TextConfig(combine=combine)), "window"), expected)


def test_negatives_compete_in_their_own_prompt_only(encode):
    encoder = TextEncoder(encode, TextConfig(negatives=("object",)))
    queries = encoder.queries([Prompt("dome", ("roof", "hat")), Prompt("wall")])
    assert [len(group) for group in queries.negative] == [3, 1]
    own = queries.vectors[list(queries.negative[0])]
    torch.testing.assert_close(own, encoder.vectors(["object", "roof", "hat"]))


def test_every_text_is_encoded_once(encode):
    encoder = TextEncoder(encode)
    for _ in range(3):
        encoder.queries([Prompt("dome"), Prompt("lintel", ("dome",))])
    assert len(encode.asked) == len(set(encode.asked))


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("windows on the left tower", "windows"),
        ("the big door at the front", "door"),
        ("main entrance", "entrance"),
        ("upper windows", "windows"),
        ("the left tower", "tower"),
        *[
            (whole, whole)
            for whole in ("rose window", "left", "clock on the tower", "table top", "top", "top of a column")
        ],
    ],
)
def test_where_a_thing_is_is_not_searched_for_and_that_is_said(typed, expected, encode):
    assert searched(typed) == expected
    assert (caution(typed) is None) == (typed == expected)
    encoder = TextEncoder(encode)
    queries = encoder.queries([Prompt(typed)])
    torch.testing.assert_close(queries.vectors[queries.positive[0][-1]], encoder.vectors([expected])[0])


@pytest.mark.parametrize("typed", ["the", "42", "of the", "What is this?", "…", "3 & 4", "1,000"])
def test_prompts_that_name_nothing_are_said_to(typed):
    assert "does not name a visible object" in caution(typed)


@pytest.mark.parametrize("typed", ["The Thinker", "thing", "42nd street", "Ö", "窓", "a b", "its arch"])
def test_names_are_not_called_nothing(typed):
    assert caution(typed) is None


@pytest.mark.parametrize(("typed", "said"), [("red roof", True), ("red", False), ("colored glass", False)])
def test_colors_are_said_to_be_ignored(typed, said):
    assert bool(caution(typed)) is said and searched(typed) == typed


@pytest.mark.parametrize(
    ("typed", "phrases"),
    [
        ('"doors"', ["doors"]),
        ("doors; big  gates, arcades", ["doors", "big gates", "arcades"]),
        ("“a; b”, c", ["a; b", "c"]),
        ("", []),
        ('" "', []),
    ],
)
def test_negatives_of_an_option_are_read_as_those_of_a_prompt(typed, phrases):
    assert listed_phrases([typed]) == phrases


@pytest.mark.parametrize("typed", ["Big Ben", "The Last Supper", "First Baptist Church"])
def test_a_name_is_searched_for_whole(typed):
    assert searched(typed) == typed and caution(typed) is None


def test_capital_letters_need_no_clip():
    def no_clip(texts):
        raise AssertionError(texts)

    encoder = TextEncoder(no_clip, known={"rose window": torch.eye(3)[0]})
    assert torch.equal(encoder.vectors(["Rose Window"])[0], torch.eye(3)[0])
