"""Finding files by names that other programs wrote: with other folders, slashes, capitals or endings."""

from __future__ import annotations

import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from urllib.parse import unquote

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import unreadable

_Parts = tuple[str, ...]


def normal_parts(name: str) -> _Parts:
    """Split a name into folders and file name, in one form: slashes of Windows, drives, `.` and leading `..`
    and spaces at the ends are removed, capitals are small, and letters with accents are one character."""
    name = unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()
    parts: list[str] = []
    for part in map(str.strip, name.split("/")):
        if part == ".." and parts:
            parts.pop()
        elif part not in ("", ".", "..") and not part.endswith(":"):
            parts.append(part)
    return tuple(parts)


def name_finder(files: Iterable[str]) -> Callable[[str], list[str]]:
    """Index files for names of other programs: return a function that finds those that fit a name best, one
    if it is found, several if it is ambiguous. They have the same name, or else the same without its ending;
    among several, the folders agree with the name's the farthest up."""
    by_name, by_stem = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
    for file in files:
        last = normal_parts(file)[-1]
        by_name[last].append(file)
        by_stem[Path(last).stem].append(file)

    def find(name: str) -> list[str]:
        for written in (name, unquote(name)):  # as in addresses: my%20photo.jpg
            *folders, last = normal_parts(written) or ("",)
            fitting = by_name.get(last) or by_stem.get(last) or by_stem.get(Path(last).stem, [])
            if fitting:
                return _deepest(tuple(folders), fitting)
        return []

    return find


def _deepest(folders: _Parts, files: Sequence[str]) -> list[str]:
    """Keep the files whose folders agree with these the farthest up. Of several, keep those of which all
    folders do, if there are any."""
    depths = {}
    for file in files:
        own = normal_parts(file)[:-1]
        pairs = list(zip(reversed(own), reversed(folders), strict=False))
        depth = next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))
        depths[file] = (depth, depth == len(own))
    best = max(depths.values(), default=None)
    return [file for file in files if depths[file] == best]


def _same_folders(name: str, file: str) -> bool:
    return normal_parts(name)[:-1] == normal_parts(file)[:-1]


def resolve(
    names: Sequence[str], exists: Callable[[str], bool], list_files: Callable[[], Iterable[str]], what: str
) -> tuple[dict[str, str], dict[str, UserError]]:
    """Find the file of each name, and say how many have others than their names.

    Args:
        names: names as they were written, each once.
        exists: whether a name is a file as it is. Such files are never given to another name.
        list_files: lists all files, relative to the folder; called only if a name is not a file.
        what: what the files are, for the message: "photos".

    Returns:
        the files by name, and the reasons for names that fit several files or share one. A name that fits
        none is in neither.
    """
    found = {name: name for name in names if exists(name)}
    others = [name for name in names if name not in found]
    if not others:
        return found, {}
    taken = set(found.values())
    find, refused = name_finder(file for file in list_files() if file not in taken), dict[str, UserError]()
    guessed = dict[str, str]()
    for name in others:
        fitting = find(name)
        fitting = [file for file in fitting if not unreadable(Path(file))] or fitting
        if fitting == [name]:
            continue  # it is something else than a file
        if len(fitting) == 1:
            guessed[name] = fitting[0]
        elif fitting:
            refused[name] = UserError(f"it is not there, and fits {len(fitting)} files: {some(fitting, 3)}")
    # Of several names, the one whose folders are the file's own keeps it: a/x for a/x.jpg, not b/x.
    owners = Counter(file for name, file in guessed.items() if _same_folders(name, file))
    shared = {file for file, count in Counter(guessed.values()).items() if count > 1}
    for name in [name for name, file in guessed.items() if file in shared]:
        if owners[file := guessed[name]] != 1 or not _same_folders(name, file):
            del guessed[name]
            refused[name] = UserError(f"it is not there, and {file} fits other names as well")
    if guessed:
        name, file = next(iter(guessed.items()))
        say(f"{len(guessed)} of {len(names)} {what} have other names than listed: {some([name])} is {file}")
    return found | guessed, refused


def listed(names: Sequence[str], known: Collection[str], what: str) -> frozenset[str]:
    """Find the photos that a list (`what`, in messages) names among the `known` ones, as `resolve` does.
    Raises ValueError for a name that fits none or several."""
    found, _ = resolve(list(dict.fromkeys(names)), known.__contains__, lambda: known, what)
    missing = [name for name in names if name not in found]
    expect(not missing, f"{what} names {missing[:1]}, which fits no photo, or several")
    return frozenset(found.values())
