"""What a dataset consists of, as data: demonstrations, and the images rendered from them.

Each training seed has its own demonstrations: those of seed s are recorded at the start seeds
`first_seed(s)`, `first_seed(s)` + 1, …, `SEEDS_EACH` at most. So training seeds share no start, and
none uses starts of the validation and test banks. Training seed 0 begins at `names.TRAIN_SEED`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from surgicai_vision.core import names
from surgicai_vision.core.config import JSON, LATER, TaskConfig, check_frame_stride
from surgicai_vision.core.errors import InputError, check_at_least, check_name
from surgicai_vision.core.variants import Variants
from surgicai_vision.demos.demonstrator import CHOOSING_DEMONSTRATORS, SCRIPTED_DEMONSTRATORS
from surgicai_vision.demos.disturbance import Disturbance, check_aim, check_late

SEEDS_EACH = 20_000
"""Start seeds that belong to one training seed."""
TRAINING_SEEDS = 20
"""Training seeds that have start seeds of their own: the bank of training is below 400,000."""
SEEDS_TRIED = 4
"""Most seeds tried per demonstration, with one demonstration added (`demos.record`)."""
MOST_EPISODES = 4_000
"""Most demonstrations of a dataset: few enough that all starts are the training seed's own."""
DEMONSTRATORS = (*SCRIPTED_DEMONSTRATORS, *sorted(CHOOSING_DEMONSTRATORS))
"""Who may demonstrate: a scripted expert, or one that re-poses other demonstrations."""


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations that policies are trained on, and the images rendered from them.

    Attributes:
        name: the name that the policies' `demonstrations` refer to.
        task: the task that is demonstrated.
        episodes: how many.
        view: rendered views; empty where no policy learns from images.
        demonstrator: who demonstrates.
        noise: noise on the actions that the demonstrator executes (`Disturbance`).
        jaw_noise: noise on the jaw's motion while it is not told to close.
        aim_noise: how far beside the grasp or the holes the tool aims now and then [mm].
        upset_fraction: share of episodes in which something goes wrong once (`envs.upset`).
        late: largest delay [control steps] with which a demonstrator that goes back notices a loss.
        post_success_steps: control steps an episode goes on after its success.
        frame_stride: control steps from frame to frame.
        env: fields of `TaskConfig` that replace the plan's, such as a world that varies more than
            the one policies are evaluated in.
        visits_of: name of demonstrations of the whole procedure, whose visits of this task
            (`demos.cut`) are rendered with these.
        appearance: the looks they are rendered in (`core.variants`), "train", "varied", "random" or
            one of their families; "" renders each as it was recorded.
        distractors: most distractors in the rendered scene; 0 leaves those that were recorded.
        variants: in how many looks each demonstration is rendered.
        corruption: largest strength of smoke, blur and pixel noise on the rendered images.
        shift: strength by which cameras, lights and joints are off in the rendered images.
        aimed: crops are rendered where a detector would see the jaws.
        of: name of demonstrations of the same task, which are re-posed to new starts where the
            demonstrator is "multiply" (`demos.multiply`).
        learner: name of a policy of the same task that acts at first, from starts that it was not
            trained on, while the labels stay the demonstrator's (`experiments.dagger`); the
            demonstrations it was trained on are rendered with these.

    Raises:
        InputError: a number out of its range, variants without a look to draw, a demonstrator
            without the demonstrations it re-poses, or such demonstrations without that demonstrator
            or with a learner.
        UnknownName: no such demonstrator or appearance.
    """

    name: str
    task: str
    episodes: int
    view: tuple[str, ...]
    demonstrator: str = "expert"
    noise: float = 0.6
    post_success_steps: int = 0
    frame_stride: int = 5
    upset_fraction: float = 0.0
    late: int = 0
    env: Mapping[str, JSON] = field(default_factory=dict)
    visits_of: str = ""
    appearance: str = field(default="", metadata=LATER)
    distractors: int = field(default=0, metadata=LATER)
    variants: int = field(default=1, metadata=LATER)
    of: str = field(default="", metadata=LATER)
    corruption: float = field(default=0.0, metadata=LATER)
    learner: str = field(default="", metadata=LATER)
    jaw_noise: float = field(default=0.0, metadata=LATER)
    aim_noise: float = field(default=0.0, metadata=LATER)
    shift: float = field(default=0.0, metadata=LATER)
    aimed: bool = field(default=False, metadata=LATER)

    def __post_init__(self) -> None:
        check_name("demonstrator", self.demonstrator, DEMONSTRATORS)
        check_late(self.demonstrator, self.disturbance)
        check_aim(self.demonstrator, self.task, self.disturbance)
        check_frame_stride(self.frame_stride)
        check_at_least(1, **{f"demonstrations {self.name}: episodes": self.episodes})
        check_at_least(0, post_success_steps=self.post_success_steps)
        if bool(self.of) != (self.demonstrator in CHOOSING_DEMONSTRATORS):
            choosing = ", ".join(sorted(CHOOSING_DEMONSTRATORS))
            raise InputError(
                f"demonstrations {self.name}: demonstrator is '{self.demonstrator}' and of is "
                f"'{self.of}'; with demonstrator {choosing}, and with no other, give "
                "of: NAME, the demonstrations to re-pose."
            )
        if self.of and self.learner:
            raise InputError(
                f"demonstrations {self.name}: learner '{self.learner}' cannot act in what is "
                f"re-posed from '{self.of}'; leave out learner or of."
            )
        _ = self.looks  # refuses variants that cannot be drawn

    @property
    def looks(self) -> Variants | None:
        """The looks each is rendered in; None keeps the recorded look."""
        return Variants.asked(
            self.appearance,
            self.distractors,
            self.variants,
            self.corruption,
            self.shift,
            self.aimed,
        )

    def shown(self, env: TaskConfig) -> TaskConfig:
        """Return the task as their images show it, where it is recorded in `env`."""
        return self.looks.shown(env) if self.looks else env

    @property
    def disturbance(self) -> Disturbance:
        """What disturbs their episodes."""
        return Disturbance(
            self.noise,
            upset_fraction=self.upset_fraction,
            late=self.late,
            jaw_noise=self.jaw_noise,
            aim_noise=self.aim_noise,
        )

    @property
    def manner(self) -> str:
        """How they are demonstrated, in words."""
        after = self.post_success_steps
        who = f"re-posed from '{self.of}'" if self.of else f"by the scripted {self.demonstrator}"
        parts = [who]
        parts += [f"executed with noise {self.noise:g}"] if self.noise else []
        parts += [f"its open jaws with noise {self.jaw_noise:g}"] if self.jaw_noise else []
        parts += [f"aiming off by {self.aim_noise:g} mm"] if self.aim_noise else []
        parts += [f"upset in {self.upset_fraction:.0%}"] if self.upset_fraction else []
        parts += [f"noticed up to {self.late} steps late"] if self.late else []
        parts += [f"going on for {after} steps after their success"] if after else []
        parts += [f"a frame every {self.frame_stride} steps"] if self.frame_stride > 1 else []
        parts += [f"with the visits in '{self.visits_of}'"] if self.visits_of else []
        if self.learner:
            parts.append(f"'{self.learner}' acting at first, added to what that was trained on")
        parts += [f"each in {self.looks.text}"] if self.looks else []
        return ", ".join(parts)


@dataclass(frozen=True)
class DatasetConfig:
    """Everything that decides a dataset.

    Attributes:
        env: the task and its scene.
        demonstrations: what is recorded and rendered.
        size: height and width of the images [px].
        depth: render depth as well as RGB.
        first_seed: start seed of the first demonstration.
        visited: the whole procedures whose visits are rendered too, where `demonstrations` says so.
        multiplied: the demonstrations that are re-posed, where `demonstrations` says so.
        learned: what the learner was trained on, where one acts in the demonstrations.
    """

    env: TaskConfig
    demonstrations: Demonstrations
    size: int = 224
    depth: bool = False
    first_seed: int = names.TRAIN_SEED
    visited: "DatasetConfig | None" = None
    multiplied: "DatasetConfig | None" = None
    learned: "DatasetConfig | None" = None

    @property
    def next_seed(self) -> int:
        """The first start seed after those that the demonstrations may have tried."""
        return self.first_seed + SEEDS_TRIED * (self.demonstrations.episodes + 1)


def first_seed(training_seed: int) -> int:
    """Return the first start seed of a training seed's demonstrations.

    Raises:
        InputError: a training seed without start seeds of its own.
    """
    if not 0 <= training_seed < TRAINING_SEEDS:
        raise InputError(
            f"seed is {training_seed}; allowed: 0 to {TRAINING_SEEDS - 1}, the training seeds that "
            "have their own demonstrations."
        )
    return names.TRAIN_SEED + SEEDS_EACH * training_seed
