"""Things made by hand, and who looks at them."""

import numpy as np

from lang3dxl_ns.things.grammar import Sight
from lang3dxl_ns.things.thing import Thing

SIGHT = Sight(np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, 1.0, 0]))


def thing(number: int, word: str, center, size=(1.0, 1.0, 1.0), views: int = 3) -> Thing:
    rows = np.array([number])
    return Thing(number, word, 1.0, views, np.array(center, float), np.eye(3), np.array(size, float), rows)
