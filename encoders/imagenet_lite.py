"""`imagenet-lite`: EfficientNet-Lite0, the embedded default; its weights are installed by pip."""

from encoders.card import Plugin
from encoders.packaged import CARD, build

IMAGENET_LITE = Plugin(CARD, build)
