"""What a detector is, and where it lies; light to import.

A detector's folder holds `detector.safetensors`, the weights, and `detector.json`, its card, which
is written last. `released:detector` is the one that comes with the product, or that of the folder
of released policies which is used instead (`training.released`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from surgicai_vision.core.config import digest, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, check_name
from surgicai_vision.core.files import PACKAGE, read_json
from surgicai_vision.training.released import is_released, released_folder

CARD = "detector.json"
WEIGHTS = "detector.safetensors"
FORMAT = 1
CAMERAS = ("front", "back")
PER_DEMO = 12
EPOCHS = 10
"""What a training takes by default: cameras, states of each demonstration, passes over them."""
RELEASED = "released:detector"
"""Name of the detector that comes with the product."""


@dataclass(frozen=True)
class DetectorCard:
    """What a detector is.

    Attributes:
        cameras: the cameras it knows, in the order of its last layer.
        demos: hash of the demonstrations it was trained on.
        images: number of images trained on.
        epochs: passes over them.
        seed: training seed.
        errors: camera → median distance from the true place on held-out demonstrations, as a share
            of the image's height.
        code_version: version of the code that made it.
        weights_sha256: hash of its weights.
        format: version of this layout.
        per_demo: states of each demonstration that were rendered; None in cards that do not say it.
    """

    cameras: tuple[str, ...]
    demos: str
    images: int
    epochs: int
    seed: int
    errors: Mapping[str, float]
    code_version: str
    weights_sha256: str = ""
    format: int = FORMAT
    per_demo: int | None = None


def detector_folder(given: str | Path) -> Path:
    """Return the folder of a detector: that of `RELEASED`, or the given one.

    `RELEASED` is `detector` in the folder of released policies that the environment names, and the
    package's where that folder has none: `surgicai-vision release` builds policies alone.

    Raises:
        UnknownName: another name than `RELEASED` with its prefix.
    """
    if not is_released(given):
        return Path(given)
    check_name("released detector", str(given), (RELEASED,))
    own = released_folder() / "detector"
    return own if own.exists() else PACKAGE / "released" / "detector"


def read_card(folder: Path) -> DetectorCard:
    """Return what the detector in a folder is.

    Raises:
        BadFile: there is none, or its card is damaged or of another version.
    """
    path = Path(folder) / CARD
    if not path.is_file():
        raise BadFile(
            f"{folder} is not a detector (no {CARD} in it); make one with "
            "'surgicai-vision train-detector'."
        )
    plain = read_json(path)
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise BadFile(f"{path} is of another version; train the detector again.")
    if plain.pop("card_sha256", None) != digest(plain):
        raise BadFile(f"{path} was changed after training; train the detector again.")
    try:
        return from_mapping(DetectorCard, plain, str(path))
    except (InputError, TypeError) as error:
        raise BadFile(f"{path} is damaged ({error}); train the detector again.") from None


def check_cameras(card: DetectorCard, cameras: tuple[str, ...]) -> None:
    """Raise `UnknownName` for a camera that the detector was not trained on."""
    for camera in cameras:
        check_name("camera of the detector", camera, card.cameras)
