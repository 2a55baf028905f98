"""From texts to a question: prompts with their taught words, their relevancy, thresholds, and trust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.console import say_once
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.doubt import doubtful, peaks
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.query.text import Prompt, listed_phrases, parse_prompts, texts_of
from lang3dxl_ns.query.thresholds import match_thresholds
from lang3dxl_ns.query.trust import alike, judged
from lang3dxl_ns.query.vocabulary import closest_word, common_words
from lang3dxl_ns.words.taught_words import known_word

Text: TypeAlias = str | Prompt | Float[Tensor, " c"] | Float[Array, " c"]
"""A text as `parse_prompts` reads it, or a vector in the space of the scene's CLIP."""


def ask(
    scene: Answering,
    texts: Text | Sequence[Text],
    negatives: Sequence[str] = (),
    foreground: str | None = None,
    threshold: float | None = None,
) -> Question:
    """Put prompts to a scene; see `Scene.ask`."""
    requested = scene.config.threshold if threshold is None else threshold
    if requested is not None and not 0 <= requested <= 1:
        raise UserError(f"the threshold is {requested}: give a relevancy from 0 to 1")
    rivals = listed_phrases(texts_of(negatives, "a negative"))
    prompts = [replace(p, negatives=(*p.negatives, *rivals)) for p in prompts_of(scene, texts)]
    within = scene.config.foreground if foreground is None else foreground
    everything = [*prompts, *(prompts_of(scene, within) if within else ())]
    if own := [p.text for p in everything if known_word(p.text) in map(known_word, p.negatives)]:
        raise UserError(f"{own[0]!r} is its own negative, so nothing can match it: name another negative")
    queries, count = scene.queries(everything), len(prompts)
    relevancy = scene.engine.of_gaussians(queries)
    doubts = [
        doubt if prompt.taught is None else prompt.taught.doubt
        for prompt, doubt in zip(everything, scene.doubts.of(relevancy), strict=True)
    ]
    for prompt, doubt in zip(everything[count:], doubts[count:], strict=True):
        if advice := doubtful(prompt.text, doubt, prompt.taught is not None):
            say_once(f"foreground {prompt.text}: {advice}")
    strict = [bool(prompt.negatives or prompt.taught) for prompt in everything]
    levels = match_thresholds(relevancy, doubts, strict)
    fits = peaks(relevancy).tolist()
    trusts = [
        judged(
            prompt.text,
            doubts[i],
            fits[i],
            taught=prompt.taught is not None or prompt.vector is not None,
            foreign=scene.foreignness,
            meant=closest_word(prompt.text, (*scene.words, *common_words())),
            alike=alike(prompt.text, scene.synonyms(prompt), relevancy[i] > levels[i], scene.anchors),
        )
        for i, prompt in enumerate(prompts)
    ]
    return Question(
        scene.engine,
        tuple(prompts),
        queries,
        relevancy,
        tuple(doubts[:count]),
        tuple(trusts),
        levels[:count] if requested is None else (requested,) * count,
        levels[count:],
        scene.config.min_alpha,
    )


def ask_one(scene: Answering, text: Text, threshold: float | None = None) -> Question:
    """Put one prompt to a scene. Raises UserError as `ask` does, and for a text that holds several."""
    question = ask(scene, text, threshold=threshold)
    if len(question.prompts) > 1:
        raise UserError(f"{text!r} are {len(question.prompts)} prompts: ask for one at a time")
    return question


def prompts_of(scene: Answering, texts: Text | Sequence[Text]) -> list[Prompt]:
    """Parse prompts, and attach the taught words. Raises UserError if there are no prompts."""
    prompts = list[Prompt]()
    if isinstance(texts, Array) and texts.dtype.kind in "OU":
        texts = texts.ravel().tolist()
    listed: Sequence[Any] = texts if isinstance(texts, list | tuple) else [texts]
    for text in listed:
        if isinstance(text, Tensor | Array):
            text = Prompt("vector", vector=_vector(scene, text))
        for prompt in [text] if isinstance(text, Prompt) else parse_prompts(text, scene.words):
            word = None if prompt.vector is not None else scene.words.get(known_word(prompt.text))
            prompts.append(prompt if word is None else replace(prompt, taught=word))
    return prompts or parse_prompts("")


def _vector(scene: Answering, values: Tensor | Array) -> Float[Tensor, " c"]:
    """Return a vector to search for at unit length. Raises UserError if it has another shape, or is 0."""
    vector = values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values, np.float32))
    width = scene.semantics()[0].clip_dim
    if vector.shape != (width,) or not bool(vector.isfinite().all()) or not bool(vector.any()):
        raise UserError(
            f"a vector to search for has shape {list(vector.shape)}: this scene's CLIP has {width} "
            "finite numbers, not all of them 0"
        )
    return (vector.double() / vector.double().norm()).float()
