"""`colour-grid`: the mean colour of each square of an 8 × 8 grid. It has no weights."""

from pathlib import Path

from torch import nn

from encoders.base import EncoderCard, Plugin

SIDE, SQUARES = 224, 8

CARD = EncoderCard(
    name="colour-grid",
    architecture=f"mean over {SQUARES} × {SQUARES} squares",
    source="surgicai-vision-example",
    revision="0.1.0",
    filename=None,
    sha256=None,
    licence="MIT",
    offline=True,
    input_size=SIDE,
    input_range=(0.0, 1.0),
    mean=(0.5, 0.5, 0.5),
    std=(0.25, 0.25, 0.25),
    interpolation="bilinear",
    dim=3 * SQUARES**2,
    paper="none",
)


def build(card: EncoderCard, path: Path | None) -> tuple[EncoderCard, nn.Module]:
    """Return the network: (B, 3, 224, 224) normalised images → (B, 192)."""
    return card, nn.Sequential(nn.AvgPool2d(SIDE // SQUARES), nn.Flatten())


COLOUR_GRID = Plugin(CARD, build)
