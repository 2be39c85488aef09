"""What a hierarchical policy consists of, as data; light to import, for the command line.

Interface:

* `HierarchicalConfig`: who decides, who acts, and when a subtask ends.
* `read_hierarchical(path)`, `hierarchical_yaml(config)`: from its YAML file and back.

`evaluation.hierarchical` describes how such a policy acts.
"""

from dataclasses import dataclass
from pathlib import Path

from surgicai_vision.core import names
from surgicai_vision.core.config import DWELL, from_mapping, to_mapping
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.core.files import read_yaml
from surgicai_vision.core.yaml_text import dump_yaml
from surgicai_vision.training.run_config import TERMINATIONS

ORDER = "order"
HLP = "hlp"
"""Name of the high-level policy, and of its kind."""
SUFFIXES = (".yaml", ".yml")
MAX_STEPS = 2000
"""Control steps of an episode: ten subtasks of full length."""
CONFIDENCES = (0.5, 0.7, 0.9)
"""Values of `HierarchicalConfig.confidence` that a sweep of the ends tries by default."""
PATIENCES = (1, 2, 3)
"""Likewise for `HierarchicalConfig.patience`."""


@dataclass(frozen=True)
class HierarchicalConfig:
    """Who decides, who acts, and when a subtask ends.

    Attributes:
        hlp: folder of the high-level policy's checkpoint, "released:hlp", or "order".
        grasp: what acts in the subtask, a checkpoint's folder, a released policy or a baseline;
            likewise place, insert, handoff and pullout. A file names no code: "module:factory" is
            refused.
        termination: one of `TERMINATIONS`.
        steps: control steps a subtask may take.
        decisions: decisions an episode may take.
        max_steps: control steps an episode may take.
        grasp_hold: control steps a grasp must hold before a `privileged` end, at most the env's
            own `DWELL`; a policy that learned to search (`demos.search_expert`) lets go again
            sooner than that.
        confidence: probability, by the high-level policy's softmax, that another subtask must have
            before it counts as named (`learned`). A higher one means later ends and fewer false
            ones.
        patience: how often in a row the high-level policy must name the same other subtask to end
            the present one (`learned`).
        decide_every: control steps between queries of the high-level policy (`learned`); only then
            are its images rendered and encoded. A subtask takes at least `decide_every` times
            `patience` steps.
    """

    hlp: str
    grasp: str
    place: str
    insert: str
    handoff: str
    pullout: str
    termination: str = "learned"
    steps: int = 200
    decisions: int = 50
    max_steps: int = MAX_STEPS
    grasp_hold: int = DWELL
    confidence: float = 0.5
    patience: int = 3
    decide_every: int = 5

    def __post_init__(self) -> None:
        check_name("termination", self.termination, TERMINATIONS)
        check_at_least(
            1,
            steps=self.steps,
            decisions=self.decisions,
            max_steps=self.max_steps,
            patience=self.patience,
            decide_every=self.decide_every,
        )
        if not 1 <= self.grasp_hold <= DWELL:
            raise InputError(f"grasp_hold is {self.grasp_hold}; allowed: 1 to {DWELL}.")
        if not 0.0 <= self.confidence < 1.0:
            raise InputError(f"confidence is {self.confidence}; allowed: at least 0 and below 1.")
        if self.hlp == ORDER and self.termination == "learned":
            raise InputError(
                "A learned termination needs a high-level policy; give hlp: a checkpoint folder, "
                "or termination: privileged, which ends a subtask by its measured success."
            )

    @property
    def low(self) -> dict[str, str]:
        """Subtask → what acts in it, in the order of the subtasks."""
        policies = (self.grasp, self.place, self.insert, self.handoff, self.pullout)
        return dict(zip(names.SUBTASKS, policies, strict=True))

    @property
    def advance(self) -> str:
        """Who advances the env to its next subtask: `TaskConfig.advance`."""
        return advance_of(self.termination)


def advance_of(termination: str) -> str:
    """Return who advances the env to its next subtask (`TaskConfig.advance`) for a termination."""
    return "told" if termination == "learned" else "success"


def read_hierarchical(path: Path) -> HierarchicalConfig:
    """Read the YAML file of a hierarchical policy.

    Raises:
        BadFile: it cannot be read.
        InputError: a key or a value that is not allowed.
    """
    return from_mapping(HierarchicalConfig, read_yaml(path), str(path))


def hierarchical_yaml(config: HierarchicalConfig) -> bytes:
    """Return the YAML file of a hierarchical policy, its keys in the order of the fields."""
    return dump_yaml(to_mapping(config)).encode()
