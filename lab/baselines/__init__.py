"""Baselines from the literature, which implement the feature decoder's interface.

Importing this package adds them to the names that `--pipeline.model.decoder.name` takes.
"""

from lab.baselines.fmgs import PlaceField
from lab.baselines.langsplat import LangSplat
from lab.baselines.lifting import DirectFeatures, Feature3DGS, LiftedFeatures
from lang3dxl_ns.components.decoders import DECODERS
from lang3dxl_ns.components.feature_decoder import Decoder

BASELINES: dict[str, type[Decoder]] = {
    "feature3dgs": Feature3DGS,
    "fmgs": PlaceField,
    "langsplat": LangSplat,
    "direct": DirectFeatures,
    "lifting": LiftedFeatures,
}
DECODERS |= BASELINES
