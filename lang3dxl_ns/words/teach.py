"""Teaching a scene: words learned from marks in its photos, carried from elsewhere, and what to mark next."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.answer import check_views
from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.ask import ask
from lang3dxl_ns.query.text import taught_prompt
from lang3dxl_ns.scene.record import same_clip
from lang3dxl_ns.words.learn_word import Weights, learn
from lang3dxl_ns.words.taught_words import Example, TaughtWord, known_word


def learned_word(
    scene: Answering, word: str, examples: Sequence[Example], selection: Bool[Tensor, " n"] | None = None
) -> TaughtWord:
    """Learn a word from marks in a scene's photos; see `Scene.teach`."""
    prompt = taught_prompt(word)
    photos = [scene.file.photo(example.photo) for example in examples]
    listed = [replace(e, photo=p.name, size=p.file_size) for e, p in zip(examples, photos, strict=True)]
    # A command that is repeated, such as one that was killed, teaches nothing twice.
    pairs = {str(example.to_json()): (example, photo) for example, photo in zip(listed, photos, strict=True)}
    listed = [example for example, _ in pairs.values()]
    weights = [Weights.of(example, photo, scene.splats) for example, photo in pairs.values()]
    if selection is not None:
        selection = torch.as_tensor(selection, device=scene.device)
        weights = [Weights(w.seen * selection, torch.zeros_like(w.seen), w.seen) for w in weights]
    queries = scene.text.plain_queries([prompt.text]).to(scene.device)
    learned = learn(prompt.text, listed, weights, scene.engine, queries)
    return replace(learned, clip=scene.file.clip_identity, scene=Path(scene.file.data).name)


def carried_word(scene: Answering, word: TaughtWord) -> TaughtWord:
    """Adapt a word that was taught elsewhere to a scene; see `Scene.carrying`."""
    sizes = {photo.name: photo.file_size for photo in scene.photos}
    marked = [e for e in word.examples if e.photo in sizes and e.size in (None, sizes[e.photo])]
    # Two folders may have one name, with some photos of the same names.
    if word.scene == Path(scene.file.data).name and len(marked) > len(word.examples) / 2:
        with suppress(UserError):
            return learned_word(scene, word.name, marked)
    same = same_clip(word.clip, scene.file.clip_identity)
    if len(word.vector) != scene.semantics()[0].clip_dim or not same:
        raise UserError(f"{word.name!r} was learned with a CLIP other than this scene's: teach it again")
    return replace(word, examples=(), precision={})


def least_certain_photo(scene: Answering, word: str) -> str:
    """Find the training photo in which a taught word is least certain; see `Scene.unsure`."""
    taught = scene.words.get(known_word(word))
    if taught is None:
        raise UserError(f"{word!r} was not taught: lang3dxl words lists what was")
    check_views(scene)
    chance = ask(scene, taught.name).relevancy[0]
    marked = {scene.file.photo(example.photo).name for example in taught.examples}
    views = {name: view for name, view in scene.visible.items() if name not in marked} or scene.visible
    open_question = chance * (1 - chance)
    unsure = {name: view.pixels @ open_question[view.rows.long()] for name, view in views.items()}
    return max(unsure, key=lambda name: float(unsure[name]))
