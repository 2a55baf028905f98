"""Vocabulary and captions of the small CLIP: classes of pixels, their words, captions of crops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lab.landmark.labels import ELEMENTS, PARTS
from lab.landmark.materials import MATERIALS
from lang3dxl_ns.query.relevancy import CANONICAL

PHOTO_CLASSES = ("facade", "road", "balcony", "fence", "shop", "sign")
"""Classes only in labelled photos; the others are the generator's, and some occur in photos too."""
CLASSES = (*PARTS, *ELEMENTS[1:], *PHOTO_CLASSES)
"""A pixel's class is its element if it has one, else its part."""
CLASS = {name: index for index, name in enumerate(CLASSES)}
UNLABELED = len(CLASSES)
"""Label of an unlabelled photo pixel."""

GENERIC = len(CLASSES)
"""Class of the captions that fit every crop equally."""
ABSENT = len(CLASSES) + 1
"""Class of captions that fit no crop: words for what neither world shows."""

# class: (singular, plural), the most common word first
_WORDS: dict[str, tuple[tuple[str, str], ...]] = {
    "sky": (("sky", "skies"), ("cloud", "clouds"), ("blue sky", "cloudy skies")),
    "ground": (("ground", "lawns"), ("pavement", "pavements"), ("square", "squares"), ("grass", "paths")),
    "wall": (("wall", "walls"), ("masonry", "building walls"), ("stone wall", "stone walls")),
    "roof": (("roof", "roofs"), ("rooftop", "rooftops"), ("gable roof", "gable roofs")),
    "dome": (("dome", "domes"), ("cupola", "cupolas"), ("onion dome", "onion domes"), ("vault", "vaults")),
    "tower": (
        ("tower", "towers"),
        ("bell tower", "bell towers"),
        ("belfry", "belfries"),
        ("turret", "turrets"),
        ("campanile", "campaniles"),
        ("church tower", "church towers"),
    ),
    "spire": (
        ("spire", "spires"),
        ("steeple", "steeples"),
        ("pinnacle", "pinnacles"),
        ("fleche", "fleches"),
        ("pointed spire", "pointed spires"),
    ),
    "minaret": (
        ("minaret", "minarets"),
        ("mosque minaret", "mosque minarets"),
        ("slender minaret", "slender minarets"),
        ("prayer tower", "prayer towers"),
    ),
    "column": (("column", "columns"), ("pillar", "pillars"), ("colonnade", "colonnades"), ("post", "posts")),
    "clutter": (("niche", "niches"), ("chimney", "chimneys"), ("recess", "recesses")),
    "tree": (
        ("tree", "trees"),
        ("vegetation", "greenery"),
        ("bush", "bushes"),
        ("foliage", "leaves"),
        ("plant", "plants"),
        ("hedge", "hedges"),
        ("shrub", "shrubs"),
    ),
    "person": (("person", "people"), ("tourist", "tourists"), ("visitor", "visitors"), ("man", "crowds")),
    "car": (("car", "cars"), ("vehicle", "vehicles"), ("parked car", "parked cars")),
    "house": (("house", "houses"), ("neighbouring building", "neighbouring buildings"), ("home", "homes")),
    "lamp": (("lamp", "lamps"), ("lamp post", "lamp posts"), ("street light", "street lights")),
    "window": (
        ("window", "windows"),
        ("rose window", "rose windows"),
        ("arched window", "arched windows"),
        ("round window", "round windows"),
        ("lancet window", "lancet windows"),
        ("pane", "panes"),
        ("oculus", "window openings"),
        ("stained window", "stained windows"),
    ),
    "portal": (
        ("portal", "portals"),
        ("door", "doors"),
        ("doorway", "doorways"),
        ("entrance", "entrances"),
        ("gate", "gates"),
        ("gateway", "gateways"),
        ("archway", "archways"),
        ("entry", "entries"),
    ),
    "facade": (("facade", "facades"), ("building", "buildings"), ("house front", "house fronts")),
    "road": (("road", "roads"), ("street", "streets"), ("asphalt", "roadways"), ("driveway", "driveways")),
    "balcony": (
        ("balcony", "balconies"),
        ("balcony railing", "balcony railings"),
        ("balustrade", "railings"),
    ),
    "fence": (("fence", "fences"), ("garden fence", "garden fences"), ("garden wall", "garden walls")),
    "shop": (
        ("shop", "shops"),
        ("shop window", "shop windows"),
        ("store", "stores"),
        ("storefront", "shop fronts"),
    ),
    "sign": (("sign", "signs"), ("traffic sign", "traffic signs"), ("traffic light", "traffic lights")),
}

# things absent from both worlds, so that their texts are far from every crop
_ABSENT_WORDS = tuple(
    word
    for line in (
        "airplane anchor apple armchair baby backpack banana basketball bathtub bear bed bee beetle",
        "boat bottle bowl bread broccoli butterfly cake camel camera candle carrot cat cheese chicken",
        "coffee computer couch cow crocodile cup deer desk dinosaur dog dolphin donut dragon drum",
        "duck eagle egg elephant fish football fork fox fruit giraffe glacier glove goat guitar hair",
        "hammer hand hat helicopter horse jacket jellyfish kangaroo keyboard kitchen kitten knife",
        "lake laptop lemon lion lizard microscope microwave monkey mountain mouse mushroom ocean",
        "octopus orange oven owl oyster paint panda parachute parrot pencil penguin phone piano pig",
        "pillow pizza potato printer rabbit rainbow refrigerator ring robot rocket sandwich scissors",
        "sea shark sheep ship shirt shoe sink skateboard skeleton smoke snake soap sofa spider spoon",
        "squirrel starfish strawberry submarine suitcase surfboard tank teapot teddy telephone",
        "telescope television tennis tent tiger toaster toilet tomato toothbrush trumpet turtle vase",
        "violin volcano wallet washing whale wolf yacht zebra",
    )
    for word in line.split()
)

# label: other classes whose captions also fit it, and how well
_ALSO: dict[str, dict[str, float]] = {
    "facade": {"wall": 0.6, "house": 0.5},
    "wall": {"facade": 0.6},
    "house": {"facade": 0.6},
    "road": {"ground": 0.7},
    "shop": {"facade": 0.4},
}
_PHOTOS_FACADE = ("roof", "portal", "column", "tower", "spire", "dome", "clutter", "house")
# label: classes that may be present but unnamed, because the annotators did not distinguish them
_MAY_BE: dict[str, tuple[str, ...]] = {
    "facade": _PHOTOS_FACADE,
    "shop": ("window", "portal", "wall", "sign"),
    "balcony": ("wall", "window", "clutter", "column"),
    "fence": ("wall", "column"),
    "sign": ("lamp",),
    "ground": ("road",),
    **{part: ("facade",) for part in _PHOTOS_FACADE if part != "house"},
}


def _label_table(entries: dict[str, dict[str, float]]) -> Float[Array, "l k"]:
    return np.array([[entries.get(label, {}).get(name, 0.0) for name in CLASSES] for label in CLASSES])


FIT_OF_LABEL = np.eye(len(CLASSES)) + _label_table(_ALSO)
"""[label, class]: how well a caption of the class fits a crop of this label alone."""
MAY_BE = np.concatenate(
    [
        _label_table({label: dict.fromkeys(names, 1.0) for label, names in _MAY_BE.items()}),
        np.ones((1, UNLABELED)),
    ]
)
"""[label, class]: 1 if a crop of the label may show the class unnamed; the last label is UNLABELED."""

# adjective: the materials it is true of
_ADJECTIVES: dict[str, tuple[str, ...]] = {
    "stone": ("limestone", "sandstone", "granite", "marble", "banded stone"),
    "limestone": ("limestone",),
    "sandstone": ("sandstone",),
    "granite": ("granite",),
    "marble": ("marble",),
    "white": ("marble",),
    "brick": ("red brick", "yellow brick"),
    "red brick": ("red brick",),
    "yellow brick": ("yellow brick",),
    "plastered": ("plaster",),
    "striped": ("banded stone",),
    "slate": ("slate",),
    "tiled": ("clay tile", "glazed tile"),
    "red tiled": ("clay tile",),
    "glazed": ("glazed tile",),
    "grey": ("lead", "granite", "slate"),
    "lead": ("lead",),
    "green": ("copper",),
    "copper": ("copper",),
    "golden": ("gold",),
    "gilded": ("gold",),
    "gold": ("gold",),
    "wooden": ("wood",),
    "bronze": ("bronze",),
    "metal": ("bronze", "iron", "lead", "copper"),
    "glass": ("glass",),
    "stained glass": ("stained glass",),
    "colourful": ("stained glass",),
    "dark": ("shadow", "iron", "glass", "bronze"),
    "leafy": ("foliage",),
    "green grass": ("grass",),
    "gravel": ("gravel",),
    "paved": ("paving",),
}
ADJECTIVES = tuple(_ADJECTIVES)
_TRUE_OF = {m: [i for i, fits in enumerate(_ADJECTIVES.values()) if m in fits] for m in MATERIALS}
FITS = np.array([[material in fits for material in MATERIALS] for fits in _ADJECTIVES.values()])
"""[adjective, material]: whether the adjective is true of the material."""

_FAMILY_WORDS: dict[str, tuple[str, ...]] = {
    "cathedral": ("cathedral", "church", "basilica"),
    "mosque": ("mosque",),
    "hall": ("hall", "synagogue", "domed hall"),
}
FAMILIES = tuple(_FAMILY_WORDS)
_ON_A_BUILDING = frozenset(
    CLASS[name]
    for name in ("wall", "roof", "dome", "tower", "spire", "minaret", "column", "clutter", "window", "portal")
)

# {} the bare phrase, {a} the phrase with its article; queries are bare words, so six templates are too
_TEMPLATES = (
    *("{0}",) * 6,
    "{a}",
    "the {0}",
    "a photo of {a}",
    "a photo of the {0}",
    "a picture of {a}",
    "an image of {a}",
    "a view of the {0}",
    "a close-up of {a}",
    "a detail of the {0}",
    "there is {a}",
)
_COMMON_WORD, _WITH_ADJECTIVE, _WITH_FAMILY = 0.4, 0.25, 0.25


@dataclass(frozen=True)
class Caption:
    """A text and its meaning: a class, and if mentioned an adjective and a family (-1: not mentioned)."""

    text: str
    class_: int
    adjective: int = -1
    family: int = -1


def words_of(class_: int) -> list[str]:
    """Every word for a class, singular and plural; the canonical phrases for GENERIC."""
    if class_ == GENERIC:
        return list(CANONICAL)
    if class_ == ABSENT:
        return list(_ABSENT_WORDS)
    return [word for pair in _WORDS[CLASSES[class_]] for word in pair]


def draw_caption(class_: int, material: int, family: int, rng: np.random.Generator) -> Caption:
    """A caption of a crop: `class_` made of `material` on a landmark of `family` (indices; -1: unknown)."""
    if class_ >= GENERIC:
        phrase, plural, adjective, family = str(rng.choice(words_of(class_))), True, -1, -1
    else:
        pairs = _WORDS[CLASSES[class_]]
        plural = rng.random() < 0.5
        choice = 0 if rng.random() < _COMMON_WORD else int(rng.integers(len(pairs)))
        phrase = pairs[choice][plural]
        fitting = _TRUE_OF[MATERIALS[material]] if material >= 0 and rng.random() < _WITH_ADJECTIVE else []
        adjective = int(rng.choice(fitting)) if fitting else -1
        if adjective >= 0:
            phrase = f"{ADJECTIVES[adjective]} {phrase}"
        if class_ not in _ON_A_BUILDING or rng.random() >= _WITH_FAMILY:
            family = -1
    article = "" if plural else "an " if phrase[0] in "aeiou" else "a "
    text = _TEMPLATES[rng.integers(len(_TEMPLATES))].format(phrase, a=article + phrase)
    if family >= 0:
        text += f" of a {rng.choice(_FAMILY_WORDS[FAMILIES[family]])}"
    return Caption(text, class_, adjective, family)


def corpus(rng: np.random.Generator, count: int = 20_000) -> Iterator[str]:
    """Texts to train a tokenizer on: every word once, then `count` captions of random classes."""
    for class_ in range(len(CLASSES) + 1):
        yield from words_of(class_)
    for _ in range(count):
        class_, material = int(rng.integers(len(CLASSES) + 1)), int(rng.integers(len(MATERIALS)))
        yield draw_caption(class_, material, int(rng.integers(len(FAMILIES))), rng).text
