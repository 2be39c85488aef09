"""Session: the state machine of teleoperation, one control step per tick.

    waiting ──moves, Enter──► driving ──ended──► judged ──→──► kept, next start
       └──────────◄── ← (same start) ◄──┴────◄─────┘

→ keeps an episode that succeeded and goes on to the next start. If there is no success yet, it
gives the start up: in `waiting` at once, in `driving` after the episode was judged a failure. ←
discards and goes back to the same start. Esc stops; a success that waits for an answer is kept. An
episode starts when something moves after nothing was held, so a key still held from the last one
does not start the next.

A session has no clock: the same inputs give the same files.
"""

from dataclasses import dataclass

from surgicai_vision.core import names
from surgicai_vision.core.errors import PhysicsError
from surgicai_vision.demos.rollout import EpisodeRecorder
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.teleoperation.input_map import InputMapping
from surgicai_vision.teleoperation.inputs import DISCARD, JAW, KEEP, START, STOP, VIEW, Input
from surgicai_vision.teleoperation.recordings import DEMONSTRATOR, Recordings

WAITING = "waiting"
DRIVING = "driving"
JUDGED = "judged"
STOPPED = "stopped"
MOST_UNMADE = 20
"""Starts in a row that cannot be made after which a session ends."""


@dataclass(frozen=True)
class Rules:
    """What a session does without asking.

    Attributes:
        episodes: stop when this many more were kept; None goes on until Esc.
        auto_keep: keep a success without asking.
        keep_failures: → keeps episodes without success too.
        skip_idle: the world stands still while nothing is held.
    """

    episodes: int | None = None
    auto_keep: bool = False
    keep_failures: bool = False
    skip_idle: bool = False


@dataclass(frozen=True)
class Status:
    """What a person is shown of a session.

    Attributes:
        state: "waiting", "driving", "judged" or "stopped".
        message: what happened and what to do, one line.
        success: whether the current episode succeeded, once judged.
        episode: number that the next kept episode gets.
        seed: seed of the current start.
        kept, discarded, skipped: counts in this session.
        steps, limit: control steps of the attempt, and how many it may take.
        subtask, arm: the subtask under way, and its arm.
        distance: distance from the goal [m].
        angle: angle from the goal [rad].
        contact: both jaws touch the needle.
        view: the leading view.
        fine: the fine modifier is held.
    """

    state: str
    message: str
    success: bool
    episode: int
    seed: int
    kept: int
    discarded: int
    skipped: int
    steps: int
    limit: int
    subtask: str
    arm: str
    distance: float
    angle: float
    contact: bool
    view: str
    fine: bool


class Session:
    """A person's session with one env; see the module's docstring.

    Args:
        env: the env, of obs_type "state".
        mapping: maps inputs to actions.
        recordings: holds the kept episodes.
        views: the cameras shown; the first leads.
        rules: what happens without asking.
    """

    def __init__(
        self,
        env: SuturingEnv,
        mapping: InputMapping,
        recordings: Recordings,
        views: tuple[str, ...],
        rules: Rules = Rules(),
    ):
        self.env = env
        self.rules = rules
        self.kept = self.discarded = self.skipped = self.steps_kept = 0
        self._mapping = mapping
        self._recordings = recordings
        self._views = views
        self._leading = 0
        self._fine = False
        self._was_released = False
        self._state = WAITING
        self._message = ""
        self._go_on()

    @property
    def over(self) -> bool:
        """Return True if the session has stopped."""
        return self._state == STOPPED

    @property
    def view(self) -> str:
        """Return the leading view."""
        return self._views[self._leading]

    def status(self) -> Status:
        """Return what the person is shown now."""
        info = self._attempt.info
        return Status(
            state=self._state,
            message=self._message,
            success=self._state == JUDGED and self._attempt.success,
            episode=len(self._recordings.seeds),
            seed=self._attempt.seed,
            kept=self.kept,
            discarded=self.discarded,
            skipped=self.skipped,
            steps=len(self._attempt),
            limit=self.env.config.max_steps,
            subtask=self.env.subtask.name,
            arm=self.env.subtask.arm,
            distance=float(info["d_trans"]),
            angle=float(info["d_angle"]),
            contact=bool(info["contact"]),
            view=self.view,
            fine=self._fine,
        )

    def tick(self, user_input: Input) -> None:
        """Take the input of one control step."""
        self._fine = user_input.fine
        for event in user_input.events:
            if not self.over:
                self._handle(event)
        if self._state == WAITING:
            self._wait(user_input)
        if self._state == DRIVING:
            self._drive(user_input)

    def _handle(self, event: str) -> None:
        """Handle an event in the current state."""
        if event == VIEW:
            self._leading = (self._leading + 1) % len(self._views)
        elif event == STOP:
            self._stop()
        elif event == START and self._state == WAITING:
            self._start()
        elif event == DISCARD and self._state != WAITING:
            self.discarded += 1
            self._reset(self._attempt.seed, "Discarded. Same start again.")
        elif event == KEEP:
            self._advance()

    def _advance(self) -> None:
        """Keep the episode, or judge it, or give the start up, whichever is due."""
        if self._state == DRIVING and len(self._attempt):
            self._judge("you ended it")
            if self._keepable:
                self._keep()
        elif self._state == JUDGED and self._keepable:
            self._keep()
        else:
            self.discarded += self._state == JUDGED
            self.skipped += 1
            seed = self._attempt.seed
            self._recordings.skip(seed, "given up")
            self._go_on(f"Start {seed} given up.")

    @property
    def _keepable(self) -> bool:
        """Return True if → keeps the judged episode."""
        return self._attempt.success or (self.rules.keep_failures and self._attempt.is_physical)

    def _wait(self, user_input: Input) -> None:
        """Start when something moves after everything was released."""
        starts = user_input.is_moving and self._was_released
        self._was_released = self._was_released or not user_input.is_moving
        if starts or JAW in user_input.events:
            self._start()

    def _start(self) -> None:
        self._state = DRIVING
        self._message = "Recording."

    def _drive(self, user_input: Input) -> None:
        """Take a step and judge the episode if that ended it."""
        is_idle = not (user_input.is_moving or JAW in user_input.events or self._mapping.is_busy)
        if self.rules.skip_idle and is_idle:
            return
        if self._attempt.step(self._mapping.action(user_input, self.view)):
            reason = "the needle is dropped" if self._attempt.info.get("dropped") else "time is up"
            self._judge(reason if self._attempt.is_physical else "physics error")
            if self._attempt.success and self.rules.auto_keep:
                self._keep()

    def _judge(self, reason: str) -> None:
        """End the attempt; `reason` says why it ended if it did not succeed."""
        self._state = JUDGED
        if self._attempt.success:
            self._message = "Success. → keeps it, ← does it again."
        else:
            keeps = "keeps it anyway" if self._keepable else "goes on to the next start"
            self._message = f"No success ({reason}). ← does it again, → {keeps}."

    def _keep(self) -> None:
        """Write the episode and go on."""
        number = len(self._recordings.seeds)
        self._recordings.keep(self._attempt.demo())
        self.kept += 1
        self.steps_kept += len(self._attempt)
        kept = f"Kept as episode {number} ({len(self._attempt) / names.FPS:.1f} s)."
        if self.rules.episodes is not None and self.kept >= self.rules.episodes:
            self._state = STOPPED
            self._message = f"{kept} All {self.kept} episodes are recorded."
            return
        self._go_on(kept)

    def _stop(self) -> None:
        """Stop; a success that waits is kept, an attempt under way is discarded."""
        if self._state == JUDGED and self._attempt.success:
            self._keep()
        elif self._state != WAITING:
            self.discarded += 1
        self._state = STOPPED
        self._message = f"{self.kept} kept. Everything is written."

    def _go_on(self, message: str = "") -> None:
        """Wait at the next start; one that cannot be made is given up."""
        for _ in range(MOST_UNMADE):
            seed = self._recordings.next_seed
            try:
                self._reset(seed, message)
                return
            except PhysicsError as error:
                self._recordings.skip(seed, str(error))
                self.skipped += 1
                message = f"{message} Start {seed} cannot be made, so it is left out.".strip()
        raise PhysicsError(
            f"{MOST_UNMADE} starts of '{self.env.config.task}' in a row cannot be made."
        )

    def _reset(self, seed: int, message: str = "") -> None:
        """Wait at the start of `seed`."""
        self.env.reset(seed=seed)
        self._mapping.reset()
        self._attempt = EpisodeRecorder(self.env, seed, DEMONSTRATOR)
        self._attempt.info = self.env.measure()
        self._was_released = False
        self._state = WAITING
        self._message = f"{message} Move to begin.".strip()
