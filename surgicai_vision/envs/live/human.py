"""Human: `render_mode="human"`: an env displays itself while other code steps it.

It uses MuJoCo's window if there is a display, else a page served by this machine, whose address it
prints. Both run at real time at most. The page has no playback buttons: the code that steps the env
is the player.
"""

import sys
from typing import TYPE_CHECKING, final

from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.pacer import Pacer
from surgicai_vision.core.tasks import task_text
from surgicai_vision.envs.episode_monitor import EpisodeMonitor
from surgicai_vision.envs.live.browser import ENDED, PLAYING, STOPPED, LivePage, LiveStatus
from surgicai_vision.envs.live.views import LiveViews
from surgicai_vision.envs.live.window import Window, has_display
from surgicai_vision.envs.moment import present_moment
from surgicai_vision.envs.success import Info

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv

SIZE = 448
SHOWN = ("front", "back")


@final
class Human:
    """Shows one env, from its first reset on until it is closed.

    Args:
        env: the env.
    """

    def __init__(self, env: "SuturingEnv"):
        self._env = env
        self._pacer = Pacer()
        self._window = Window(env.model, env.data) if has_display() else None
        self._page = None if self._window else _PageOfEnv(env)

    def begin(self, info: Info) -> None:
        """Show the start of an episode."""
        if self._page:
            self._page.begin(info)
        self.step(info)

    def step(self, info: Info) -> None:
        """Show the state after a step, in real time."""
        if self._window and self._window.is_open:
            self._window.draw()
        elif self._page:
            self._page.step(info, self._pacer)
        self._pacer.wait()

    def close(self) -> None:
        """Close the window or the page."""
        if self._window:
            self._window.close()
        if self._page:
            self._page.close()


@final
class _PageOfEnv:
    """The page of one env."""

    def __init__(self, env: "SuturingEnv"):
        self._env = env
        self._monitor = EpisodeMonitor(env)
        self._views = LiveViews(env, SHOWN, SIZE)
        self._live = LivePage(task_text(env.task), camera_names(), controls=False)
        self._live.__enter__()
        self._episode = 0
        self._steps = 0
        self._info: Info = {}
        print("\n".join(self._live.server.invitation), file=sys.stderr, flush=True)

    def begin(self, info: Info) -> None:
        """Begin another episode."""
        self._episode += 1
        self._steps = -1
        self._monitor.reset()
        self._live.begin(self._episode)

    def step(self, info: Info, pacer: Pacer) -> None:
        """Record the measures of a step, and draw if a page is waiting for an image.

        An env that was not reset since it was opened, because its state was restored, begins here.
        """
        if not self._episode:
            self.begin(info)
        self._steps += 1
        if self._steps:
            self._monitor.update(info)
        self._info = info
        self._live.add_point(float(info["d_trans"]), self._monitor.force)
        for command in self._live.commands():
            self._views.handle(command)
        ended = bool(info["is_success"] or info["physics_error"])
        if self._live.screen.wants_image() and (ended or pacer.can_draw()):
            self._live.screen.show(self._views.render(), self._status(ENDED if ended else PLAYING))

    def close(self) -> None:
        """Show that the env was closed, and stop."""
        if self._info:
            self._live.screen.show(self._views.render(), self._status(STOPPED))
        self._live.__exit__()
        self._views.close()

    def _status(self, state: str) -> LiveStatus:
        moment = present_moment(self._env, self._info, self._monitor, self._steps)
        return LiveStatus(
            state=state,
            message="The env was closed." if state == STOPPED else "Another program steps the env.",
            views=self._views.shown,
            episode=self._episode,
            seed=-1,
            limit=self._env.config.max_steps,
            is_procedure=self._env.task == names.SUTURE,
            moment=moment,
            speed=1.0,
            reached=0.0,
            go_on=True,
            successes=0,
            episodes=0,
            points=self._live.points,
        )
