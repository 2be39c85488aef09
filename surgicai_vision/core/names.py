"""Every name that several modules use, once: tasks, arms, cameras, modalities, dataset keys.

Other modules import these and never spell them out. Names follow gymnasium, LeRobot and dVRK.
"""

from types import MappingProxyType

SUBTASKS = ("grasp", "place", "insert", "handoff", "pullout")
"""The five subtasks in the order of the procedure; a subtask's index is its `phase` and its
class.
"""

SUTURE = "suture"
TASKS = (*SUBTASKS, SUTURE)

TASK_TEXTS = MappingProxyType(
    {
        "grasp": "Grasp the needle with the right-hand instrument.",
        "place": "Place the needle tip at the entry point, perpendicular to the tissue.",
        "insert": "Drive the needle through the tissue until its tip leaves the exit.",
        "handoff": "Grasp the needle's tip side with the left-hand instrument.",
        "pullout": "Pull the needle wholly out of the tissue to the end point.",
        "suture": "Throw one stitch: grasp, place, insert, hand off and pull out the needle.",
    }
)
"""Task name → the sentence stored as LeRobot's `task`."""

PSM1 = "psm1"
PSM2 = "psm2"
ARMS = (PSM1, PSM2)
ACTIVE_ARM = MappingProxyType(
    {"grasp": PSM2, "place": PSM2, "insert": PSM2, "handoff": PSM1, "pullout": PSM1}
)
"""Subtask → the arm its action moves."""

FIXED_CAMERAS = ("front", "front_right", "back")
WRIST_CAMERAS = ("wrist_psm1", "wrist_psm2")
ENDOSCOPE_CAMERAS = ("endo_left", "endo_right")
"""The two eyes of a da Vinci endoscope."""
CROPS = (
    "front_psm1",
    "front_psm2",
    "back_psm1",
    "back_psm2",
    "endo_left_psm1",
    "endo_left_psm2",
    "endo_right_psm1",
    "endo_right_psm2",
)
"""Crops of a fixed camera's image about an arm's jaws (`scene.crops`)."""
CAMERAS = (*FIXED_CAMERAS, *WRIST_CAMERAS, *CROPS[:4], *ENDOSCOPE_CAMERAS, *CROPS[4:])
"""Our cameras and crops; `core.cameras` knows those of other distributions too, and every view.

The index in this tuple is the camera's number (`core.cameras.camera_number`): append new ones.
"""
RGB = "rgb"
DEPTH = "depth"
SEGMENTATION = "segmentation"
MODALITIES = (RGB, DEPTH, SEGMENTATION)
PARTS = ("background", "phantom", "needle", "thread", "psm1", "psm2")
"""Named parts; a part's index is its value in a segmentation image."""

TRAIN_APPEARANCES = ("silicone", "mucosa", "skin", "muscle", "fat")
"""Families of looks for training."""
HELDOUT_APPEARANCES = ("liver", "bowel", "scar")
"""Families that no training may see."""
VARIED_APPEARANCES = tuple(f"varied_{name}" for name in TRAIN_APPEARANCES)
"""The families for training, over cloths and in trays of any colour and of random patterns."""
RANDOM_APPEARANCES = tuple(f"random_{name}" for name in TRAIN_APPEARANCES)
"""The same, with tissues of any colour, many of random patterns, and any light."""
APPEARANCES = (
    *TRAIN_APPEARANCES,
    *HELDOUT_APPEARANCES,
    *VARIED_APPEARANCES,
    *RANDOM_APPEARANCES,
)
"""Families of looks (`scene.visual.families`). A state holds a family's index here: only append."""
TRAIN = "train"
HELDOUT = "heldout"
VARIED = "varied"
RANDOM = "random"
APPEARANCE_SETS = MappingProxyType(
    {
        TRAIN: TRAIN_APPEARANCES,
        VARIED: VARIED_APPEARANCES,
        RANDOM: (*VARIED_APPEARANCES, *RANDOM_APPEARANCES),
        HELDOUT: HELDOUT_APPEARANCES,
    }
)
"""Sets of families, as `RandomisationConfig.appearance` names them → their families."""

OBS_TYPES = ("state", "goal", "relative", "pixels", "pixels_agent_pos")
REWARDS = ("sparse", "dense", "staged")
GRASPS = ("friction", "attach")
TORQUES = ("effective", "dvrk")
TISSUES = ("channels", "soft")
INKS = ("alike", "due")
TISSUE_FORCES = ("phantom", "skin", "liver")
LAYOUTS = ("simple", "3dmed", "3dmed_straight")

ACTION_NAMES = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "jaw")
STATE_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "jaw")
ACTION_MODES = ("increments", "absolute")
"""How an env is acted on: increments of the active arm, or both arms' set-points
(`envs.absolute`).
"""
INCREMENTS, ABSOLUTE = ACTION_MODES
BOTH_ARMS_NAMES = tuple(f"{arm}_{name}" for arm in ARMS for name in STATE_NAMES)
SETPOINT_NAMES = ("x", "y", "z", "rx", "ry", "rz", "jaw")
PRIVILEGED_NAMES = tuple(
    f"{part}_{name}" for part in ("now", "goal", "error") for name in STATE_NAMES
)

_POSE_NAMES = (
    *(f"position.{axis}" for axis in "xyz"),
    *(f"orientation.{axis}" for axis in "xyzw"),
)
ABSOLUTE_STATE_NAMES = tuple(
    name for arm in ARMS for name in (*(f"{arm}_pose.{part}" for part in _POSE_NAMES), f"{arm}_jaw")
)
"""Elements of `envs.absolute.measured`, named as in Open-H-Embodiment (`dataset.open_h`)."""
ABSOLUTE_ACTION_NAMES = tuple(
    name
    for arm in ARMS
    for name in (*(f"{arm}_sp.{part}" for part in _POSE_NAMES), f"{arm}_jaw_sp")
)
"""Elements of an action in action mode "absolute"."""

RELATIVE_NAMES = (
    *("x", "y", "z"),
    *(f"tip_{axis}_axis_{along}" for axis in "xy" for along in "xyz"),
    "jaw",
    *(f"error_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")),
    *(f"fine_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")),
    *("met", "demanded"),
)
"""Elements of obs_type "relative" (`envs.relative`)."""

# LeRobot keys.
STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
ACTION = "action"
REWARD = "next.reward"
DONE = "next.done"
SUCCESS = "next.success"
SEED = "seed"
PHASE = "phase"
CONTACT = "contact"
NEEDLE_POSE = "needle_pose"
BOTH_ARMS = "both_arms"
"""Measured tip pose and jaw of psm1, then of psm2, each in its own base."""
SETPOINT = "setpoint"
"""How far the active arm's set point lies from its measured tip pose and jaw."""
PRIVILEGED_STATE = "privileged_state"
"""The 21 values of obs_type "state" with the goal; not a LeRobot key, so no policy is fed it."""

RELATIVE_STATE = "relative_state"
"""The 24 values of obs_type "relative" with the goal; in no dataset, the env provides it."""

STATES_WITH_GOAL = (PRIVILEGED_STATE, RELATIVE_STATE)
"""What no image policy may be fed."""

CLOCK = "clock"
"""The time since the subtask began, encoded by `config.clock`; computed, in no dataset."""
PROGRESS = "progress"
"""The progress of the subtask as another policy predicts it (`training.progress_input`)."""
STAGE = "stage"
"""The subtask that is due and the progress within the present one (`training.visits.stages`)."""
ACTION_CHUNK = "action_chunk"
"""The actions of a run of control steps around the present one (`training.chunks`)."""

META_FILE = "meta/surgicai.json"
"""Our own sidecar inside a LeRobot dataset: cameras, units, renderer, hashes, versions."""

INFO_FILE = "meta/info.json"
"""What makes a folder a LeRobot dataset, whoever wrote it."""

CALIBRATION = "calibration."
"""Prefix of the keys of a view's nominal K and T_world_camera, which are no policy's input."""

FPS = 50
"""Control steps and frames per second of simulated time."""

TRAIN_SEED = 0
VALIDATION_SEED = 500_000
TEST_SEED = 900_000
"""First seed of each bank of start states; the banks never overlap (under 400,000 seeds each)."""


def camera_of(view: str) -> str:
    """Return the camera of a view."""
    return view.removesuffix("_depth")


def is_depth_view(view: str) -> bool:
    """Return True for a view that shows a camera's depth as a grey image."""
    return view.endswith("_depth")


def frame_key(camera: str, modality: str) -> str:
    """Return an env's observation key of a camera's frame: "front", "front_depth"."""
    return camera if modality == RGB else f"{camera}_{modality}"


def image_key(view: str) -> str:
    """Return the LeRobot feature key of a view's RGB image."""
    return f"observation.images.{view}"


def depth_key(view: str) -> str:
    """Return the LeRobot feature key of a view's depth image [m]."""
    return f"observation.images.{view}_depth"


def segmentation_key(view: str) -> str:
    """Return the LeRobot feature key of a view's segmentation image (part index)."""
    return f"observation.images.{view}_segmentation"


def intrinsics_key(view: str) -> str:
    """Return the key of a view's nominal camera matrix K, (9,) row by row [pixel]."""
    return f"{CALIBRATION}{view}.K"


def extrinsics_key(view: str) -> str:
    """Return the key of a view's nominal T_world_camera, (16,) row by row [m]."""
    return f"{CALIBRATION}{view}.T_world_camera"
