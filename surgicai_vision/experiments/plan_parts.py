"""What a plan lists, as data: policies, conditions, rows that are not run; see `plan_config`."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON
from surgicai_vision.detection.card import RELEASED, detector_folder, read_card
from surgicai_vision.evaluation.hierarchical_config import HLP
from surgicai_vision.training.run_config import Shift

PARTS = (*names.SUBTASKS, HLP)
"""The parts of the whole procedure."""
AS_TRAINED = "as trained"
"""Name of the only condition of a plan that lists none."""


@dataclass(frozen=True)
class PlannedPolicy:
    """A policy of a plan.

    Attributes:
        name: its name.
        demonstrations: name of the demonstrations it is trained on.
        subtask: train on this subtask's frames of whole procedures.
        view: the views it sees; empty for proprioception alone.
        policy: its kind.
        encoder: its encoder; None takes the plan's. Likewise `pool` and `recipe`.
        change: what is changed in the recipe, "key=value" each.
        part: its part in the whole procedure, a subtask or `HLP`; empty takes the part of its name,
            unless another policy has that part.
    """

    name: str
    demonstrations: str
    subtask: str | None = None
    view: tuple[str, ...] = ()
    policy: str = "bc"
    encoder: str | None = None
    pool: str | None = None
    recipe: str | None = None
    change: tuple[str, ...] = ()
    part: str = ""

    @property
    def acts(self) -> bool:
        """Whether it is evaluated by itself; with a `part`, only in the whole procedure."""
        return self.policy != HLP and not self.part


@dataclass(frozen=True)
class Condition:
    """What an evaluation changes relative to the training.

    Attributes:
        name: its name in tables.
        policies: the policies of the plan that are evaluated in it, the whole procedure as
            `suture`; empty takes all that act.
        env: fields of `TaskConfig` that replace the plan's, each as a whole:
            `randomisation: {camera_shift: 2}` has only that axis, whatever the plan's has, and
            `randomisation: {}` none. A field that is not given is the plan's, not what some
            demonstrations alone have (`plan_config.Plan.evaluated_env`).
        procedure: fields of `HierarchicalConfig` that replace the plan's; `place: expert` replaces
            a policy with the expert.
        upset: let one thing go wrong in every episode (`envs.upset`).
        seed: training seeds that are evaluated in it; all by default.
        episodes: number of starts; the plan's by default.
        shift: an axis of robustness (`evaluation.robustness.SHIFTS`) and its strength, 0 to 1.
        aimed: cut crops where the released detector sees the jaws (`evaluation.aimed_agent`).
    """

    name: str
    policies: tuple[str, ...] = ()
    env: Mapping[str, JSON] = field(default_factory=dict)
    procedure: Mapping[str, JSON] = field(default_factory=dict)
    upset: bool = False
    seed: tuple[int, ...] = ()
    episodes: int | None = None
    shift: Shift | None = None
    aimed: bool = False

    @property
    def detector(self) -> str:
        """Hash of the weights of the detector that aims crops; "" for none."""
        return read_card(detector_folder(RELEASED)).weights_sha256 if self.aimed else ""


@dataclass(frozen=True)
class NotRun:
    """Rows of a plan that cannot be run where it was written, and what they need.

    Attributes:
        policy: their policy.
        task: their tasks.
        needs: what is needed, for the reader.
    """

    policy: str
    task: tuple[str, ...]
    needs: str
