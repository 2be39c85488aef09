"""`imagenet-lite-early`: the first three stages of `imagenet-lite`, for `--pool spatial`.

A map of 28 × 28 places still shows where a thin needle lies, at a third of the whole network's
arithmetic. The last layer's 7 × 7 map and a global feature lose that (compared in
docs/results/scene-0.1.md).
"""

import functools

from encoders.card import Plugin
from encoders.packaged import EARLY_CARD, build_behind

IMAGENET_LITE_EARLY = Plugin(EARLY_CARD, functools.partial(build_behind, []))
