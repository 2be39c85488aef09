"""The commands of `surgicai-vision`, one module each, in the order of the flow.

A command's module holds

* `app = App(name=..., help_epilogue=...)`; the epilogue is the example below `--help`.
* `Options`, a frozen dataclass: the command's options, and the schema of its `--config` file.
* `run(options, *, console)`, registered by `@app.default`. It returns the result that `--json`
  prints, with `exit_code` 1 where the command ran and found something wrong.

An option is a field `name: Annotated[type, TRAIT, ...] = default`, with traits of `options.py` or
its own `cyclopts.Parameter`. Its help is its line under `Attributes:` in the docstring, unless a
trait has a help text. How the type is read:

* `bool`: `--name` and `--no-name`.
* `tuple[type, ...]`: a comma list; the option may also be repeated.
* `type | None`: may be left out; `default_text("...")` says in `--help` what happens then.
* a field with `dataclasses.field(kw_only=False)`: a positional argument.
* `FILE_ONLY`: a table that only the `--config` file can give.

Where every option has a default, cyclopts requires `def run(options: Options = Options(), ...)`.

A command is registered by its line in `COMMANDS` (or in `COMMANDS` of a package that groups
several, such as `dataset`). It is imported only when it runs or its `--help` is requested. What
takes long to import (torch, mujoco, lerobot) is imported inside functions.

    @Parameter(name="*")
    @dataclass(frozen=True, kw_only=True)
    class Options:
        \"\"\"Options of `count`.

Attributes:
            dataset: Folder of the dataset.
            view: Views to count.
        \"\"\"

        dataset: Annotated[Path, DIRECTORY] = field(kw_only=False)
        view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
"""

from collections.abc import Mapping
from types import MappingProxyType

from cyclopts import App

PROGRAM = "surgicai-vision"

COMMANDS = MappingProxyType(
    {
        "quickstart": "Run the whole flow once, small, and write its report.",
        "doctor": "Check this machine and say what to do.",
        "scene": "Show what every camera sees.",
        "record-demos": "Record demonstrations with the scripted expert.",
        "teleoperate": "Record demonstrations with the keyboard or a gamepad.",
        "import-demos": "Import SurgicAI's recordings, ROS bags, LeRobot datasets or drive logs.",
        "cut-demos": "Cut a subtask's visits out of recordings of whole procedures.",
        "export-demos": "Turn demonstrations into transitions for SB3, d3rlpy, Minari, robomimic.",
        "render-demos": "Render demonstrations into a LeRobot dataset.",
        "dataset": "Check, convert or share a dataset.",
        "encode": "Compute a dataset's frozen features.",
        "probe": "Read the needle's pose from frozen features with a linear probe.",
        "cache": "List, measure or prune the cached features.",
        "train": "Train a policy on a dataset's features.",
        "train-detector": "Train a detector of the jaws, by which crops can be aimed.",
        "policies": "List the policies that come with the product.",
        "policy": "Share a trained policy, or tune one.",
        "evaluate": "Run a policy from held-out starts and count successes.",
        "watch": "Look at a policy while it acts, in the browser or in a window.",
        "saliency": "Show which parts of its images a policy's actions depend on.",
        "robustness": "Run a policy while light, cameras, images or the arm shift.",
        "robot": "Speak CRTK: serve the simulation as a dVRK, or drive one with a policy.",
        "sweep": "Encode, train and evaluate every run of a grid.",
        "release": "Build the policies that come with the product, from scratch.",
        "report": "Write the report on stored results.",
        "submit": "Make a leaderboard row from an evaluation.",
        "leaderboard": "Check submitted rows and write the leaderboard page.",
        "completion": "Print the script that completes commands and options in a shell.",
    }
)
"""Command → what it does, in one line."""


def register(app: App, commands: Mapping[str, str], package: str = __name__) -> None:
    """Add commands to `app` in this order; each is imported only when it is needed.

    Args:
        app: The app that gets the commands.
        commands: Command → what it does.
        package: Package with the commands' modules.
    """
    for place, (name, text) in enumerate(commands.items()):
        module = f"{package}.{name.replace('-', '_')}"
        app.command(f"{module}:app", name=name, help=text, sort_key=place)
