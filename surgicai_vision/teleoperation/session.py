"""Session: the state machine of teleoperation, one control step a tick.

    waiting ──moves, Enter──► driving ──ended──► judged ──→──► kept, next start
       └──────────◄── ← (same start) ◄──┴────◄─────┘

→ keeps an episode that succeeded and goes on to the next start. Where there is no success yet it
gives the start up: in `waiting` at once, in `driving` after the episode was judged a failure. ←
discards and goes back to the same start. Esc stops; a success that waits for its answer is kept. An
episode begins when nothing was held and something moves, so a key still held from the last one does
not start the next.

Nothing here knows the time: the same inputs give the same files.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.files import code_version
from surgicai_vision.demos.store import Demo
from surgicai_vision.teleoperation.input_mapping import Steering
from surgicai_vision.teleoperation.inputs import DISCARD, JAW, KEEP, START, STOP, VIEW, Input
from surgicai_vision.teleoperation.recordings import DEMONSTRATOR, Recordings

WAITING, DRIVING, JUDGED, STOPPED = "waiting", "driving", "judged", "stopped"


@dataclass(frozen=True)
class Rules:
    """What a session does by itself.

    Attributes:
        episodes: stop when so many more were kept; None goes on until Esc.
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
    """What the person is told.

    Attributes:
        state: "waiting", "driving", "judged" or "stopped".
        message: what happened and what to do, one line.
        success: the present episode's, once judged.
        episode: number that the next kept episode gets.
        seed: of the present start.
        kept, discarded, skipped: in this session.
        steps, limit: control steps of the attempt, and how many it may take.
        subtask, arm: what is due, and with which arm.
        distance: from the goal [m]; angle: from it [rad].
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


class Attempt:
    """One episode under way.

    Args:
        env: the env, at its start state.
        seed: of the start.
    """

    def __init__(self, env: Any, seed: int):
        self._env, self.seed = env, seed
        self._states = [env.get_state()]
        self._rows: list[tuple[Any, ...]] = []
        self.info: dict[str, Any] = {}

    def __len__(self) -> int:
        """Return the control steps so far."""
        return len(self._rows)

    @property
    def success(self) -> bool:
        """Say whether the last step met the task."""
        return bool(self.info.get("is_success"))

    @property
    def physical(self) -> bool:
        """Say whether the physics held; what diverged is never kept."""
        return not self.info.get("physics_error")

    def step(self, action: np.ndarray) -> bool:
        """Take one step; say whether the episode is over."""
        phase = self._env.phase
        _, reward, terminated, truncated, self.info = self._env.step(action)
        self._states.append(self._env.get_state())
        self._rows.append((action, phase, reward, self.info["is_success"], self.info["contact"]))
        return bool(terminated or truncated)

    def demo(self) -> Demo:
        """Return the episode as a demonstration."""
        action, phase, reward, success, contact = (
            list(column) for column in zip(*self._rows, strict=True)
        )
        return Demo(
            config=self._env.config,
            seed=self.seed,
            demonstrator=DEMONSTRATOR,
            scene_hash=self._env.scene.hash,
            code_version=code_version(),
            state=np.stack(self._states).astype(np.float64),
            action=np.stack(action).astype(np.float32),
            phase=np.asarray(phase, dtype=np.int8),
            reward=np.asarray(reward, dtype=np.float32),
            success=np.asarray(success, dtype=bool),
            contact=np.asarray(contact, dtype=bool),
        )


class Session:
    """A person's session at one env; see the module's docstring.

    Args:
        env: the env, of obs_type "state".
        steering: makes actions of inputs.
        recordings: where kept episodes go.
        views: the cameras shown; the first leads.
        rules: what happens without asking.
    """

    def __init__(
        self,
        env: Any,
        steering: Steering,
        recordings: Recordings,
        views: tuple[str, ...],
        rules: Rules = Rules(),
    ):
        self.env, self._steering, self._recordings, self.rules = env, steering, recordings, rules
        self._views, self._lead, self._fine = views, 0, False
        self.kept = self.discarded = self.skipped = self.steps_kept = 0
        self._state, self._message, self._rested = WAITING, "", False
        self._begin(recordings.next_seed, "")

    @property
    def over(self) -> bool:
        """Say whether the session has stopped."""
        return self._state == STOPPED

    @property
    def view(self) -> str:
        """Return the leading view."""
        return self._views[self._lead]

    def status(self) -> Status:
        """Return what the person is told now."""
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

    def tick(self, given: Input) -> None:
        """Take the input of one control step."""
        self._fine = given.fine
        for event in given.events:
            if not self.over:
                self._answer(event)
        if self._state == WAITING:
            self._wait(given)
        if self._state == DRIVING:
            self._drive(given)

    def _answer(self, event: str) -> None:
        """Do what an event asks for in the present state."""
        if event == VIEW:
            self._lead = (self._lead + 1) % len(self._views)
        elif event == STOP:
            self._stop()
        elif event == START and self._state == WAITING:
            self._state, self._message = DRIVING, "Recording."
        elif event == DISCARD and self._state != WAITING:
            self.discarded += 1
            self._begin(self._attempt.seed, "Discarded. The same start again.")
        elif event == KEEP:
            self._go_on()

    def _go_on(self) -> None:
        """Keep the episode, or judge it, or give the start up, whichever is due."""
        if self._state == DRIVING and len(self._attempt):
            self._judge("ended by you")
            if self._keepable:
                self._keep()
        elif self._state == JUDGED and self._keepable:
            self._keep()
        else:
            self.discarded += self._state == JUDGED
            self.skipped += 1
            seed = self._attempt.seed
            self._recordings.skip(seed, "given up")
            self._begin(self._recordings.next_seed, f"Start {seed} given up.")

    @property
    def _keepable(self) -> bool:
        """Say whether → keeps the judged episode."""
        return self._attempt.success or (self.rules.keep_failures and self._attempt.physical)

    def _wait(self, given: Input) -> None:
        """Begin when something moves that was at rest."""
        moves = given.moves and self._rested
        self._rested = self._rested or not given.moves
        if moves or JAW in given.events:
            self._state, self._message = DRIVING, "Recording."

    def _drive(self, given: Input) -> None:
        """Take a step and judge the episode if that ended it."""
        if self.rules.skip_idle and not (given.moves or JAW in given.events or self._steering.busy):
            return
        if self._attempt.step(self._steering.action(given, self.view)):
            self._judge("time is up" if self._attempt.physical else "physics error")
            if self._attempt.success and self.rules.auto_keep:
                self._keep()

    def _judge(self, reason: str) -> None:
        """End the attempt, which without success ended for `reason`."""
        self._state = JUDGED
        if self._attempt.success:
            self._message = "Success. → keeps it, ← does it again."
        else:
            keeps = "keeps it all the same" if self._keepable else "goes on to the next start"
            self._message = f"No success ({reason}). ← does it again, → {keeps}."

    def _keep(self) -> None:
        """Write the episode and go on."""
        number = len(self._recordings.seeds)
        self._recordings.keep(self._attempt.demo())
        self.kept += 1
        self.steps_kept += len(self._attempt)
        said = f"Kept as episode {number} ({len(self._attempt) / names.FPS:.1f} s)."
        if self.rules.episodes is not None and self.kept >= self.rules.episodes:
            self._state, self._message = STOPPED, f"{said} All {self.kept} are recorded."
            return
        self._begin(self._recordings.next_seed, said)

    def _stop(self) -> None:
        """Stop; a success that waits is kept, what is under way is discarded."""
        if self._state == JUDGED and self._attempt.success:
            self._keep()
        elif self._state != WAITING:
            self.discarded += 1
        self._state, self._message = STOPPED, f"{self.kept} kept. Everything is written."

    def _begin(self, seed: int, said: str) -> None:
        """Wait at the start of `seed`."""
        self.env.reset(seed=seed)
        self._steering.reset()
        self._attempt, self._rested = Attempt(self.env, seed), False
        self._attempt.info = self.env.measure()
        self._state, self._message = WAITING, f"{said} Move to begin.".strip()
