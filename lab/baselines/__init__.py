"""Baselines from the literature, which implement the feature decoder's interface.

Importing this package adds them to the names that `--pipeline.model.decoder.name` takes.
"""

from lab.baselines.fmgs import PlaceField
from lab.baselines.langsplat import LangSplat
from lab.baselines.lifting import DirectFeatures, Feature3DGS, LiftedFeatures
from lang3dxl_ns.components.decoders import DECODERS, Kind

BASELINES = {
    "feature3dgs": Kind(lambda field, clip, compression, dense: Feature3DGS(clip, dense)),
    "fmgs": Kind(lambda field, clip, compression, dense: PlaceField(field, clip, dense)),
    "langsplat": Kind(lambda field, clip, compression, dense: LangSplat(clip)),
    "direct": Kind(lambda field, clip, compression, dense: DirectFeatures(clip, dense)),
    "lifting": Kind(lambda field, clip, compression, dense: LiftedFeatures(clip, dense), False),
}
DECODERS |= BASELINES
