"""An agent whose crops lie where a detector sees the jaws (`surgicai_vision.detection`).

    spec = aimed(open_policy("outputs/train/place-…"), Path("outputs/detector"))

It looks at whole images of the crops' cameras, finds the jaws in them and cuts each crop about the
jaws of its arm, at the scale that the nominal calibration gives. So it needs neither the reported
joints nor the cameras' poses to aim, and errors of both are left out of the crops. The policy it
wraps is unchanged. Views that are no crops, such as a wrist camera's, stay as they are. Inputs
other than images still come from the reported joints.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, final

import cv2
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.cameras import CAMERAS
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.detection.card import check_cameras, detector_folder
from surgicai_vision.detection.detector import Detector, load_detector
from surgicai_vision.detection.examples import PART, WHOLE, can_be_aimed, shrunk
from surgicai_vision.evaluation.agent import (
    Actions,
    Agent,
    MakeAgent,
    Observation,
    Robot,
    WrappedAgent,
    frame_of,
    image_of,
)
from surgicai_vision.evaluation.denoised_agent import DenoisedAgent
from surgicai_vision.scene.cameras import CameraPose, Crop, crop_of
from surgicai_vision.scene.crops import whole_size

if TYPE_CHECKING:
    from surgicai_vision.core.corruption import Image
    from surgicai_vision.evaluation.policy_spec import PolicySpec


def aimed(spec: "PolicySpec", detector: str | Path) -> "PolicySpec":
    """Return a policy whose crops lie where a detector sees the jaws.

    Args:
        spec: what is evaluated.
        detector: its folder, or `detection.card.RELEASED`.

    Raises:
        BadFile: the folder holds no detector, or a damaged one.
        UnknownName: the detector does not know a camera of the policy's crops.
        InputError: a policy without crops or with depth, or a crop of an image that is not 4:3.
    """
    folder = detector_folder(detector)
    card = load_detector(folder).card
    views = spec.run.views
    crops = [crop for crop in map(crop_of, views) if crop is not None]
    if not crops or any(map(names.is_depth_view, views)):
        seen = ", ".join(views) or "no images"
        raise InputError(
            f"A detector aims crops in colour, and {spec.name} sees {seen}; give a policy with "
            "crops among its views, such as front_psm2, and no depth."
        )
    check_cameras(card, tuple(dict.fromkeys(crop.camera for crop in crops)))
    for crop in crops:
        if not can_be_aimed(crop):
            raise InputError(
                f"The image of '{crop.camera}' is {crop.aspect:g} times as wide as high, and a "
                f"detector sees {WHOLE[0]} × {WHOLE[1]}; give a policy with crops of such cameras."
            )
    return dataclasses.replace(
        spec,
        run=dataclasses.replace(spec.run, detector=card.weights_sha256),
        make=functools.partial(_make_aimed, spec.make, folder),
        about={**spec.about, "detector": str(detector)},
    )


def _make_aimed(make: MakeAgent, folder: Path) -> Agent:
    """Make the agent (in a worker process)."""
    agent, detector = make(), load_detector(folder)
    if isinstance(agent, DenoisedAgent):  # whole images stand still, crops about the jaws do not
        return DenoisedAgent(AimedAgent(agent.agent, detector), agent.frames)
    return AimedAgent(agent, detector)


@final
class AimedAgent(WrappedAgent):
    """An agent whose crops are cut from whole images.

    Args:
        agent: who acts; its views have one size, and are square or up to 4:3 wide.
        detector: finds the jaws.

    Raises:
        InputError: an agent that needs depth.
    """

    def __init__(self, agent: Agent, detector: Detector):
        if agent.depth:
            raise InputError(
                f"A detector aims crops in colour, and {agent.name} needs their depth too; leave "
                "the detector out."
            )
        super().__init__(agent)
        self._detector = detector
        self._crops = {view: crop_of(view) for view in agent.cameras}
        self._size = (agent.image_size, round(agent.image_size * agent.aspect))
        self._aimed = {crop.camera for crop in self._crops.values() if crop is not None}
        self.cameras = tuple(
            dict.fromkeys(crop.camera if crop else view for view, crop in self._crops.items())
        )
        self.image_size = WHOLE[0]
        self.aspect = WHOLE[1] / WHOLE[0]

    def part(self, camera: str) -> float:
        """Return `PART` for a camera from whose images crops are cut."""
        return PART if camera in self._aimed else 1.0

    def act(
        self, slots: Sequence[int], robots: Sequence[Robot], observations: Sequence[Observation]
    ) -> Actions:
        """Return the agent's actions (n, 7) on its crops."""
        return self.agent.act(slots, robots, [self.crops(seen) for seen in observations])

    def crops(self, observation: Observation) -> Observation:
        """Return an observation whose crops are cut when they are accessed."""
        assert isinstance(observation, Mapping), "the env of an agent with cameras shows images"
        found = LazyMapping(
            {camera: functools.partial(self._find, observation, camera) for camera in self._aimed},
            {},
        )
        seen = {
            view: functools.partial(self._cut, observation, crop, found)
            if crop
            else functools.partial(self._whole, observation, view)
            for view, crop in self._crops.items()
        }
        others = {
            key: functools.partial(frame_of, observation, key)
            for key in observation
            if key not in self.cameras
        }
        return LazyMapping({**others, **seen}, {})

    def _find(self, observation: Observation, camera: str) -> NDArray[np.float32]:
        """Return where a camera shows both arms' jaws, (2, 2), shares of width and height."""
        places, _ = self._detector.find(shrunk(image_of(observation, camera))[None], camera)
        found: NDArray[np.float32] = places[0]
        return found

    def _cut(
        self, observation: Observation, crop: Crop, found: Mapping[str, NDArray[np.float32]]
    ) -> "Image":
        """Return the crop about its arm's jaws."""
        place = found[crop.camera][names.ARMS.index(crop.arm)]
        return cut(image_of(observation, crop.camera), crop, place, self._size)

    def _whole(self, observation: Observation, camera: str) -> "Image":
        """Return what the wrapped agent's view of a camera shows."""
        return middle(image_of(observation, camera), self._size)


def middle(image: "Image", size: tuple[int, int]) -> "Image":
    """Return the middle of a whole image, as the same camera shows it in an image of another size.

    A camera's field of view is vertical, so a narrower image lacks the sides alone.

    Args:
        image: (height, width, 3).
        size: height and width of the result [pixel], not wider in proportion.
    """
    height, width = image.shape[:2]
    across = min(round(height * size[1] / size[0]), width)
    left = (width - across) // 2
    part = image[:, left : left + across]
    return np.asarray(cv2.resize(part, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def cut(image: "Image", crop: Crop, place: NDArray[np.float32], size: tuple[int, int]) -> "Image":
    """Return the part of a whole image that a crop shows when it lies about a place.

    As in `scene.crops`, a crop near the border shows the part of the image at that border.

    Args:
        image: whole image of the crop's camera, (height, width, 3).
        crop: whose scale is taken.
        place: x and y as shares of the image's width and height.
        size: height and width of the result [pixel].
    """
    camera = CAMERAS.load(crop.camera)
    assert isinstance(camera, CameraPose), "a crop is cut from a camera's image"
    height, width = image.shape[:2]
    # Pixels of the whole image per pixel of the crop.
    scale = height / whole_size(crop, camera.fovy, *size)[0]
    down, across = (scale * side / 2 for side in size)
    x = min(max(float(place[0]) * width, across), width - across)
    y = min(max(float(place[1]) * height, down), height - down)
    # The centre of the first pixel is at 0, its corner at -0.5.
    first = 0.5 * scale - 0.5
    affine = np.array([[scale, 0.0, x + (first - across)], [0.0, scale, y + (first - down)]])
    part = cv2.warpAffine(image, affine, size[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(part, np.uint8)
