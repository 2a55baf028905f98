"""Words taught in a scene's earlier file, which are kept when the scene is made anew."""

from __future__ import annotations

from pathlib import Path

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.scene_file import describe_scene_file
from lang3dxl_ns.query.teach import TaughtWord, known_word


def with_words_of(scene: Scene, earlier: Path) -> Scene:
    """Return the scene with the words of an earlier file that it doesn't know; log which are kept, and how.

    Args:
        scene: the scene that takes the file's place.
        earlier: the earlier file; a missing one has no words, and a damaged one loses them.
    """
    if not earlier.is_file():
        return scene
    try:
        words: list[TaughtWord] = describe_scene_file(earlier)["taught"]
    except UserError as error:
        say(f"Words taught in {earlier.name} are lost: {error}")
        return scene
    for word in words:
        if known_word(word.name) in scene.words:
            continue
        try:
            scene = scene.carrying(word)
        except UserError as error:
            say(f"The taught word {word.name!r} is lost: {error}")
            continue
        count = len(scene.words[known_word(word.name)].examples)
        how = f"learned anew from its examples ({count})" if count else "as it was: check it in a few photos"
        say(f"The taught word {word.name!r} is kept, {how}")
    return scene
