"""`imagenet-lite-early`: the first three stages of `imagenet-lite`, for `--pool spatial`.

A map of 28 × 28 places still says where a thin needle lies, which the last layer's 7 × 7 and a
global feature lose (docs/results/scene-0.1.md compares), at a third of the whole network's
arithmetic.
"""

import functools

from encoders.card import Plugin
from encoders.packaged import EARLY_CARD, build_behind

IMAGENET_LITE_EARLY = Plugin(EARLY_CARD, functools.partial(build_behind, []))
