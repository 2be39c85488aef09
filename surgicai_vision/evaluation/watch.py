"""Watch: an agent's episodes, one at a time, for a person who plays, pauses and steps them.

    player = Player(agent, config, seed=900_000)
    with LivePage("…", camera_names(), controls=True) as page:
        watch_on_page(player, page, LiveViews(player.env, ("front", "back"), 448))

The player steps an `evaluation.slot`, as an evaluation does, so what a person watches is what an
evaluation measures. It has no clock; the loops below keep the time.

    playing ◄─pause, play─► paused        step: one control step, then paused
       └──────── ended ◄──────┘           next, play: the next start; again: the same one
"""

from collections.abc import Callable
from typing import Protocol, final

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.pacer import Pacer
from surgicai_vision.envs.live.browser import (
    ENDED,
    PAUSED,
    PLAYING,
    SPEEDS,
    STOPPED,
    Command,
    LivePage,
    LiveStatus,
)
from surgicai_vision.envs.live.views import LiveViews
from surgicai_vision.envs.live.window import Window
from surgicai_vision.envs.moment import Moment
from surgicai_vision.evaluation.agent import Agent, Env
from surgicai_vision.evaluation.films import outcome_of
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.slot import Slot

REST_TICKS = 75
"""Ticks for which an ended episode stays before the next start begins by itself: 1.5 s."""
PATIENCE = 3
"""Ticks after which an image is due, even if late: policies that encode images are slow."""
NOTHING = Moment(0, "", "", 0.0, 0.0, False, 0.0, 0, False)
"""What is measured where a start could not be made."""

Told = Callable[[EpisodeMetrics], None]
"""Called with the row of every episode that has ended."""


class Curves(Protocol):
    """Receives what is plotted over an episode, as a `LivePage` does."""

    def begin(self, episode: int) -> None:
        """Begin another episode."""

    def add_point(self, distance: float, force: float) -> None:
        """Add the distance to the goal [m] and the force on the tissue [N] of one moment."""


@final
class Player:
    """Plays episodes; see the module's docstring.

    Args:
        agent: what acts.
        config: the task.
        seed: of the first start; the next ones follow.
        episodes: stop when this many have ended; None goes on until "stop".
        go_on: the next start begins by itself.
        playing: begin to play at once.
        curves: receives what is measured at every moment.
        told: called with the row of every episode that has ended.
    """

    def __init__(
        self,
        agent: Agent,
        config: TaskConfig,
        seed: int = names.TEST_SEED,
        episodes: int | None = None,
        go_on: bool = False,
        playing: bool = True,
        curves: Curves | None = None,
        told: Told = lambda row: None,
    ):
        self.rows: dict[int, EpisodeMetrics] = {}
        self.speed = 1.0
        self.number = 0
        self._agent = agent
        self._config = config
        self._slot = Slot(0, agent, config)
        self._episodes = episodes
        self._go_on = go_on
        self._curves = curves
        self._told = told
        self._rest = 0
        self._message = ""
        self._begin(seed, PLAYING if playing else PAUSED)

    @property
    def env(self) -> Env:
        """Return the env that is played."""
        return self._slot.env

    @property
    def over(self) -> bool:
        """Return True if the player was stopped, or has played all its episodes."""
        return self.state == STOPPED

    @property
    def moment(self) -> Moment:
        """Return what is measured now."""
        return self._slot.moments[-1] if self._slot.moments else NOTHING

    def handle(self, command: Command) -> None:
        """Carry out one of `PLAY_COMMANDS`."""
        if self.over:
            return
        if command.name == "play":
            if self.state == ENDED:
                self._begin(self.seed + 1, PLAYING)
            else:
                self._resume(PLAYING)
        elif command.name == "pause" and self.state == PLAYING:
            self._resume(PAUSED)
        elif command.name == "step" and self.state != ENDED:
            self._resume(PAUSED)
            self._step()
        elif command.name in ("next", "again"):
            state = PAUSED if self.state == PAUSED else PLAYING
            self._begin(self.seed + (command.name == "next"), state)
        elif command.name == "speed":
            self.speed = command.numbers[0]
        elif command.name == "go_on":
            self._go_on = bool(command.numbers[0])
        elif command.name == "stop":
            self._stop("Stopped.")

    def tick(self) -> None:
        """Let one control step's time pass."""
        if self.state == PLAYING:
            self._step()
        elif self.state == ENDED and self._go_on:
            self._rest += 1
            if self._rest >= REST_TICKS:
                self._begin(self.seed + 1, PLAYING)

    def status(self, views: tuple[str, ...], points: int, reached: float = 0.0) -> LiveStatus:
        """Return what a page shows.

        Args:
            views: the views that are shown.
            points: number of points of the page's curves.
            reached: share of real time at which it plays.
        """
        return LiveStatus(
            state=self.state,
            message=self._message,
            views=views,
            episode=self.number,
            seed=self.seed,
            limit=self._config.max_steps,
            is_procedure=self._config.task == names.SUTURE,
            moment=self.moment,
            speed=self.speed,
            reached=round(reached, 2) if self.state == PLAYING else 0.0,
            go_on=self._go_on,
            successes=sum(row.success for row in self.rows.values()),
            episodes=len(self.rows),
            points=points,
        )

    def _begin(self, seed: int, state: str) -> None:
        """Begin the episode of a start."""
        self.seed = seed
        self.number += 1
        self._rest = 0
        self._slot.begin(seed)
        if self._curves:
            self._curves.begin(self.number)
        self._add_point()
        self._resume(state)
        if self._slot.ended:
            self._end()

    def _resume(self, state: str) -> None:
        self.state = state
        self._message = f"{self._agent.name} acts." if state == PLAYING else "Play, or step."

    def _step(self) -> None:
        """Take one control step."""
        slot = self._slot
        slot.step(self._agent.act([0], [slot.env], [slot.observation])[0])
        self._add_point()
        if slot.ended:
            self._end()

    def _add_point(self) -> None:
        if self._curves:
            self._curves.add_point(self.moment.distance, self.moment.force)

    def _end(self) -> None:
        """Record the episode that has ended."""
        self.state = ENDED
        row = self._slot.take().row
        self.rows[row.seed] = row
        self._told(row)
        self._message = f"{outcome_of(row).capitalize()}."
        if row.error:
            self._message = f"{self._message[:-1]}: {row.error}"
        if self._episodes is not None and len(self.rows) >= self._episodes:
            self._stop(f"{self._message} That was the last.")

    def _stop(self, message: str) -> None:
        self.state = STOPPED
        self._message = message

    def close(self) -> None:
        """Free the env."""
        self._slot.env.close()


def watch_on_page(player: Player, page: LivePage, views: LiveViews) -> None:
    """Play on a page until the player is over.

    Args:
        player: plays; the page receives its curves.
        page: takes commands and shows images and status; it is already being served.
        views: draws the images.
    """
    pacer = Pacer(player.speed, patience=PATIENCE)
    images = views.render()
    drawn: tuple[object, ...] = ()
    shown: LiveStatus | None = None
    while not player.over:
        for command in page.commands():
            if not views.handle(command):
                player.handle(command)
        pacer.set_pace(player.speed)
        player.tick()
        if page.screen.wants_image() and pacer.can_draw():
            status = player.status(views.shown, page.points, pacer.reached)
            # Images are redrawn only if something that they show has changed.
            now = (player.number, status.moment.step, views.shown, views.orbit)
            if now != drawn:
                images = views.render()
            if now != drawn or status != shown:
                page.screen.show(images, status)
            drawn = now
            shown = status
        pacer.wait()
    page.screen.show(views.render(), player.status(views.shown, page.points))


def watch_in_window(player: Player, window: Window) -> None:
    """Play in MuJoCo's viewer until the player is over or the window is closed.

    Args:
        player: plays.
        window: of the player's env.
    """
    pacer = Pacer(player.speed)
    while not player.over and window.is_open:
        for key in window.pressed():
            player.handle(_command_of(key, player))
        pacer.set_pace(player.speed)
        player.tick()
        if pacer.can_draw():
            window.draw()
        pacer.wait()


def _command_of(key: str, player: Player) -> Command:
    """Return the command of a key of the window (`envs.live.window.KEYS`)."""
    if key in ("slower", "faster"):
        place = SPEEDS.index(player.speed) + (1 if key == "faster" else -1)
        return Command("speed", (SPEEDS[min(max(place, 0), len(SPEEDS) - 1)],))
    if key == "play" and player.state == PLAYING:
        return Command("pause")
    return Command(key)
