"""`policies`: list the policies that come with the product."""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from cyclopts import App

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.quickstart import aligned

if TYPE_CHECKING:
    from surgicai_vision.training.released import ReleaseCard

app = App(name="policies", help_epilogue="example:\n  surgicai-vision policies --json")


@dataclass(frozen=True)
class Line:
    """A released policy as the list shows it.

    Attributes:
        policy: its name with the prefix.
        task: the task it acts in.
        successes: successes on held-out starts.
        sees: its views.
        demonstrations: what it was trained on.
        scene: the scene's hash, shortened.
        usable: whether it can be used in the present scene.
        licence: its licence.
        problem: why it cannot be used, or "".
    """

    policy: str
    task: str = ""
    successes: str = ""
    sees: str = ""
    demonstrations: str = ""
    scene: str = ""
    usable: bool = False
    licence: str = ""
    problem: str = ""


@app.default
def run(*, console: Console) -> dict[str, object]:
    """Print one line per policy: its task, its successes and whether it fits the present scene."""
    from surgicai_vision.core.errors import InputError
    from surgicai_vision.training.released import (
        PREFIX,
        read_card,
        released_folder,
        released_names,
    )

    lines = []
    for name in released_names():
        try:
            lines.append(_line(read_card(name)))
        except InputError as error:
            lines.append(Line(f"{PREFIX}{name}", problem=str(error)))
    head = ("policy", "task", "successes", "sees", "scene", "licence")
    rows = [
        (line.policy, line.task, line.successes, line.sees, _scene(line), line.licence)
        for line in lines
    ]
    for text in aligned([head, *rows]) if rows else ():
        console.say(text)
    for line in lines:
        if line.problem:
            console.say(f"{line.policy}: {line.problem}")
    if not lines:
        console.say(f"There is no released policy in {released_folder()}.")
    if not lines or not all(line.usable for line in lines):
        console.say("`surgicai-vision release` builds them for the present scene (hours).")
    return {"folder": str(released_folder()), "policies": [asdict(line) for line in lines]}


def _line(card: "ReleaseCard") -> Line:
    """Return a card as a line."""
    from surgicai_vision.training.released import PREFIX, mismatch

    problem = mismatch(card)
    return Line(
        policy=f"{PREFIX}{card.name}",
        task=card.env.task,
        successes=card.counted,
        sees=" + ".join(card.run.views) or "proprioception alone",
        demonstrations=card.data,
        scene=card.scene_hash[:12],
        usable=not problem,
        licence=card.licence,
        problem=problem,
    )


def _scene(line: Line) -> str:
    """Return a scene's hash and whether it is the present one."""
    return f"{line.scene} ({'present' if line.usable else 'another'})" if line.scene else "–"
