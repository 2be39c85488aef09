"""`watch`: look at a policy while it acts."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import open_given
from surgicai_vision.commands.options import (
    COUNT,
    SEED,
    VIEWS,
    AcceptLicence,
    DatasetFolder,
    DetectorName,
    EnvFields,
    PolicyName,
    PolicyTask,
    WeightFiles,
    default_text,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.core.cameras import camera_names
from surgicai_vision.core.errors import InputError
from surgicai_vision.features.encoders import WeightsSource

if TYPE_CHECKING:
    from surgicai_vision.evaluation.metrics import EpisodeMetrics

app = App(
    name="watch",
    help_epilogue="""\
example:
  surgicai-vision watch expert --task suture

Open the address that it prints. On the page: space plays and pauses, → takes one step, N goes to
the next start, R to the beginning of this one; drag in the view "free" to turn it. Esc ends.""",
)
WEB_PORT = 8766


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `watch`.

    Attributes:
        task: The task.
        seed: Seed of the first start; each episode takes the next.
        episodes: Stop when this many episodes have ended.
        go_on: Begin the next start automatically.
        paused: Wait at the first start.
        window: Use MuJoCo's own viewer instead of the page; needs a display.
        port: Port of the page on this machine's loopback; 0 takes any free port.
        view: Views to show initially; the first is the leading view.
        size: Height and width of images [px].
        dataset: With policy replay, the dataset whose mean demonstration it plays.
        expert_swap: For a hierarchical policy, the subtask in which the expert acts instead.
    """

    policy: PolicyName = field(kw_only=False)
    task: PolicyTask = None
    seed: Annotated[int, SEED] = names.TEST_SEED
    episodes: Annotated[int | None, COUNT, default_text("continue until Esc")] = None
    go_on: bool = False
    paused: bool = False
    window: bool = False
    port: Annotated[int, within(0, 65535)] = WEB_PORT
    view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
    size: Annotated[int, within(64, 960), Parameter(metavar="PX")] = 448
    dataset: DatasetFolder = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    detector: DetectorName = None
    expert_swap: Annotated[str | None, Parameter(choices=names.SUBTASKS, metavar="SUBTASK")] = None
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Play episodes for a person to watch, and print how each ended."""
    from surgicai_vision.envs.live.browser import MAX_VIEWS, LivePage
    from surgicai_vision.envs.live.views import LiveViews
    from surgicai_vision.envs.live.window import Window, check_display
    from surgicai_vision.evaluation.films import outcome_of
    from surgicai_vision.evaluation.watch import Player, watch_in_window, watch_on_page
    from surgicai_vision.training.released import is_released

    if options.window:
        check_display()
    if len(options.view) > MAX_VIEWS:
        raise InputError(
            f"--view names {len(options.view)} views; the page shows at most {MAX_VIEWS} at the "
            "same time. Leave some out; its buttons change them."
        )
    spec = open_given(
        console,
        options.policy,
        options.task,
        options.env,
        options.dataset,
        WeightsSource.parse(options.weights, options.accept_licence),
        options.expert_swap,
        detector=options.detector,
    )

    def tell(row: "EpisodeMetrics") -> None:
        console.say(f"start {row.seed}: {outcome_of(row)}")

    def player_for(page: LivePage | None) -> Player:
        return Player(
            spec.make_agent(),
            spec.config,
            options.seed,
            options.episodes,
            go_on=options.go_on,
            playing=not options.paused,
            curves=page,
            told=tell,
        )

    if options.window:
        player = player_for(None)
        with Window(player.env.model, player.env.data) as window:
            watch_in_window(player, window)
    else:
        name = options.policy if is_released(options.policy) else spec.name
        title = f"{name}: {spec.config.task}"
        with LivePage(title, camera_names(), controls=True, port=options.port) as page:
            player = player_for(page)
            views = LiveViews(player.env, options.view, options.size)
            for line in page.server.invitation:
                console.note(line)
            watch_on_page(player, page, views)
            views.close()
    player.close()
    successes = sum(row.success for row in player.rows.values())
    console.say(f"{successes} of {len(player.rows)} episodes succeeded.")
    return {
        "policy": spec.name,
        "task": spec.config.task,
        "successes": successes,
        "episodes": [
            {"seed": row.seed, "success": row.success, "failure": row.failure, "steps": row.steps}
            for row in player.rows.values()
        ],
    }
