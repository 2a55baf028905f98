"""Captions of crops: true, and in the words that people type."""

import numpy as np
import pytest

from lab.clip_training.captions import (
    ABSENT,
    ADJECTIVES,
    CANONICAL,
    CLASS,
    CLASSES,
    FITS,
    GENERIC,
    corpus,
    draw_caption,
    words_of,
)
from lab.landmark.labels import CATEGORIES
from lab.landmark.materials import MATERIALS
from lang3dxl_ns.query.doubt import UNRELATED


@pytest.fixture(scope="module")
def texts():
    return list(corpus(np.random.default_rng(0), 5_000))


def captions_of(class_, material=-1, family=0, count=300):
    rng = np.random.default_rng(1)
    return [draw_caption(class_, material, family, rng) for _ in range(count)]


@pytest.mark.parametrize("phrase", CANONICAL)
def test_canonical_phrases_are_captions_of_no_class(texts, phrase):
    assert phrase in texts
    assert phrase in {caption.text for caption in captions_of(GENERIC)}
    assert not any(phrase in words_of(class_) for class_ in range(len(CLASSES)))


def test_every_class_has_words_and_no_word_belongs_to_two():
    words = [word for class_ in range(len(CLASSES) + 1) for word in words_of(class_)]
    assert len(words) == len(set(words))


@pytest.mark.parametrize("category", CATEGORIES)
def test_categories_are_captions_in_singular_plural_and_other_words(category):
    class_ = CLASS[category.removesuffix("s")]
    found = {caption.text for caption in captions_of(class_)}
    assert {category, category.removesuffix("s")} <= found
    assert len(set(words_of(class_)) & found) >= 8


def test_adjectives_are_true_of_the_material_and_named_only_when_it_is_known():
    for material, name in enumerate(MATERIALS):
        for caption in captions_of(CLASS["dome"], material, count=30):
            assert caption.adjective < 0 or (
                FITS[caption.adjective, material] and ADJECTIVES[caption.adjective] in caption.text
            ), name
    assert {caption.adjective for caption in captions_of(CLASS["dome"])} == {-1}
    assert any(
        "golden dome" in caption.text for caption in captions_of(CLASS["dome"], MATERIALS.index("gold"))
    )


def test_a_family_is_named_only_of_the_building():
    assert {caption.family for caption in captions_of(CLASS["tree"], family=1)} == {-1}
    portals = captions_of(CLASS["portal"], family=1)
    assert {caption.family for caption in portals} == {-1, 1}
    assert all(("mosque" in caption.text) == (caption.family == 1) for caption in portals)


def test_articles_fit_the_words(texts):
    assert not any(f" a {vowel}" in f" {text}" for text in texts for vowel in "aeio")
    assert "a photo of domes" in {caption.text for caption in captions_of(CLASS["dome"], count=2_000)}


def test_no_word_that_tells_doubt_was_learned(texts):
    """Otherwise the built-in CLIP would reject these words more easily than what people ask for."""
    learned = {word for text in (*texts, *words_of(ABSENT)) for word in text.lower().split()}
    assert not learned & {word for text in UNRELATED for word in text.split()}
