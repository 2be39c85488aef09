"""The trained detector.

detector = load_detector(Path("outputs/detector"))
places, confidences = detector.find(images, "front")
"""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save

from surgicai_vision.core.config import digest, to_mapping
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import write_bytes, write_json
from surgicai_vision.detection.card import CARD, WEIGHTS, DetectorCard, read_card
from surgicai_vision.detection.network import JawNetwork, read_places
from surgicai_vision.training.threads import one_thread

if TYPE_CHECKING:
    from surgicai_vision.core.corruption import Image


@final
class Detector:
    """A trained detector.

    Args:
        card: what it is.
        network: its network, on the CPU.
    """

    def __init__(self, card: DetectorCard, network: JawNetwork):
        self.card = card
        self._network = network.eval()

    def find(
        self, images: "NDArray[np.uint8]", camera: str
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where images show the jaws, and how sure that is.

        Args:
            images: (n, 120, 160, 3), whole images of one camera at the network's size.
            camera: a camera of the card.

        Returns:
            Places (n, 2, 2), x and y of psm1's and psm2's jaws as shares of width and height, and
            confidences (n, 2) from 0 to 1.
        """
        index = self.card.cameras.index(camera)
        with torch.inference_mode(), one_thread():
            answers = self._network(tensor_of(images), torch.full((len(images),), index))
            places, confidences = read_places(answers)
        return places.numpy(), confidences.numpy()


def tensor_of(images: "Image") -> torch.Tensor:
    """Return images (n, H, W, 3) uint8 as the network's input (n, 3, H, W), from 0 to 1."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255.0


def write_detector(folder: Path, card: DetectorCard, network: JawNetwork) -> DetectorCard:
    """Write weights, then card; return the card as stored."""
    content = save({name: tensor.contiguous() for name, tensor in network.state_dict().items()})
    card = replace(card, weights_sha256=hashlib.sha256(content).hexdigest())
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / WEIGHTS, content)
    plain = to_mapping(card)
    write_json(folder / CARD, {**plain, "card_sha256": digest(plain)})
    return card


def load_detector(folder: Path) -> Detector:
    """Return the detector in a folder, on the CPU.

    Raises:
        BadFile: there is none, or its files are damaged.
    """
    card = read_card(folder)
    path = Path(folder) / WEIGHTS
    network = JawNetwork(len(card.cameras))
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != card.weights_sha256:
            raise BadFile(f"{path} does not match {CARD}; train the detector again.")
        network.load_state_dict(load(content))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise BadFile(f"{path} cannot be read ({error}); train the detector again.") from None
    return Detector(card, network)
