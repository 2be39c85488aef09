"""Released policies: trained policies shipped with the product as `released:NAME`.

Interface:

* `resolve(given) -> Path`: the path of a policy given to a command. `released:grasp` becomes the
  verified folder of a checkpoint or YAML file of a hierarchical policy; a path stays as it is.
* `released_names()`, `read_card(name)`, `mismatch(card)`: what `surgicai-vision policies` lists.
* `write_released(card, contents)`: the last step of `surgicai-vision release`.

Layout of `released_folder()`, one folder per policy:

    grasp/card.json            what it is, where it came from and what it solves; written last
    grasp/checkpoint.json      a checkpoint as `train` writes it
    grasp/policy.safetensors
    suture/card.json
    suture/hierarchical.yaml   a hierarchical policy, whose parts are `released:` policies

A policy belongs to the scene it was trained in: if the present scene has another hash, it is
refused in one line that says how to rebuild it. To distribute other policies, point
`$SURGICAI_VISION_RELEASED` to a folder of the same layout.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from surgicai_vision.core.config import TaskConfig, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.core.files import PACKAGE, read_json, sha256_file, write_bytes, write_json
from surgicai_vision.training.checkpoint import WEIGHTS
from surgicai_vision.training.run_config import RunConfig, Starts

PREFIX = "released:"
VARIABLE = "SURGICAI_VISION_RELEASED"
"""Environment variable with a folder of released policies to use instead of the package's."""
CARD = "card.json"
PROCEDURE = "hierarchical.yaml"
FORMAT = 1


@dataclass(frozen=True)
class ReleaseCard:
    """What a released policy is, where it came from and what it solves.

    Attributes:
        name: its name, without the prefix.
        run: task, inputs, recipe, demonstrations and training seed.
        scene_hash: sha256 of the scene it was trained in.
        data: the demonstrations and the images it was trained on, in words.
        licence: its licence.
        encoder: the frozen encoder it needs, with the source and the licence of its weights, in
            words; empty without images.
        files: name of each file next to the card → its sha256.
        parts: name of each released policy that this one consists of → sha256 of its weights.
        command: the command that built it.
        code_version: version of this package.
        successes: successful episodes; None for a policy evaluated only as part of another.
        starts: the held-out starts they were measured on.
        solved: the first few starts that it solved; a test solves them again.
        format: version of this layout.
    """

    name: str
    run: RunConfig
    scene_hash: str
    data: str
    licence: str
    encoder: str
    command: str
    code_version: str
    files: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)
    successes: int | None = None
    starts: Starts | None = None
    solved: tuple[int, ...] = ()
    format: int = FORMAT

    @property
    def env(self) -> TaskConfig:
        """The task it acts in, and its scene."""
        return self.run.env

    @property
    def counted(self) -> str:
        """Return "97/100 (starts 900000–900099)", or "–" for a part evaluated in a whole."""
        if self.successes is None or self.starts is None:
            return "–"
        seeds = self.starts.seeds
        return f"{self.successes}/{len(seeds)} (starts {seeds[0]}–{seeds[-1]})"


def released_folder() -> Path:
    """Return $SURGICAI_VISION_RELEASED, or the folder in the installed package."""
    given = os.environ.get(VARIABLE)
    return Path(given) if given else PACKAGE / "released"


def released_names() -> tuple[str, ...]:
    """Return the name of every released policy, in alphabetical order."""
    return tuple(sorted(path.parent.name for path in released_folder().glob(f"*/{CARD}")))


def is_released(given: str | Path) -> bool:
    """Return True for a name such as "released:grasp"."""
    return str(given).startswith(PREFIX)


def resolve(given: str | Path) -> Path:
    """Return the path of a policy; a released one is verified.

    Args:
        given: "released:NAME", or the path of a checkpoint or of a hierarchical policy.

    Raises:
        UnknownName: no such policy is released; the message gives the nearest name.
        InputError: nothing is released, or the policy belongs to another scene.
        BadFile: its files or its parts do not match its card.
    """
    if not is_released(given):
        return Path(given)
    name = str(given).removeprefix(PREFIX)
    known = released_names()
    if not known:
        raise InputError(
            f"{given}: no policy is released in {released_folder()}; build them with "
            "`surgicai-vision release`."
        )
    if name not in known:
        raise UnknownName("released policy", name, known)
    card = read_card(name)
    again = f"rebuild it with `surgicai-vision release --only {name}`."
    problem = mismatch(card)
    if problem:
        raise InputError(f"{given} {problem}; {again}")
    folder = released_folder() / name
    _check_files(folder, card.files)
    for part, sha256 in card.parts.items():
        if part not in known or read_card(part).files.get(WEIGHTS) != sha256:
            raise BadFile(f"{given} was evaluated with a different {PREFIX}{part}; {again}")
    return folder / PROCEDURE if PROCEDURE in card.files else folder


def _check_files(folder: Path, files: Mapping[str, str]) -> None:
    """Raise `BadFile` unless each of a policy's files has the hash that its card names."""
    for name, sha256 in files.items():
        path = folder / name
        if not path.is_file() or sha256_file(path) != sha256:
            raise BadFile(
                f"{path} is not the file that its {CARD} was written for (sha256 differs); "
                "install the package again."
            )


def read_card(name: str) -> ReleaseCard:
    """Read the card of a released policy.

    Raises:
        BadFile: it is missing, damaged, or of another version.
    """
    path = released_folder() / name / CARD
    plain = read_json(path)
    found = plain.get("format") if isinstance(plain, dict) else None
    if found != FORMAT:
        raise BadFile(
            f"{path} has format {found!r}, of another version; this one reads {FORMAT}. Rebuild "
            f"it with `surgicai-vision release --only {name}`."
        )
    try:
        return from_mapping(ReleaseCard, plain, str(path))
    except (InputError, TypeError) as error:
        raise BadFile(
            f"{path} is of another version ({str(error).rstrip('.')}); rebuild it with "
            f"`surgicai-vision release --only {name}`."
        ) from None


def mismatch(card: ReleaseCard) -> str:
    """Return why the policy does not belong to the present scene, "" if it does."""
    from surgicai_vision.scene import build_scene  # not at the top: `--help` imports this module

    present = build_scene(card.env.scene).hash
    if present == card.scene_hash:
        return ""
    return f"was trained in scene {card.scene_hash[:12]}, and the present scene is {present[:12]}"


def write_released(card: ReleaseCard, contents: Mapping[str, bytes]) -> Path:
    """Put a policy into `released_folder()`, replacing an earlier one of the same name.

    Args:
        card: its card; `files` is filled in.
        contents: name of each file → its content.

    Returns:
        The policy's folder.
    """
    folder = released_folder() / card.name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CARD).unlink(missing_ok=True)
    for name, content in contents.items():
        write_bytes(folder / name, content)
    files = {name: sha256_file(folder / name) for name in contents}
    write_json(folder / CARD, to_mapping(replace(card, files=files)))
    return folder
