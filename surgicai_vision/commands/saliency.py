"""`saliency`: show which parts of its images a policy's actions depend on."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import open_given
from surgicai_vision.commands.options import (
    SEED,
    WHOLE_NUMBERS,
    AcceptLicence,
    DetectorName,
    EnvFields,
    PolicyTask,
    WeightFiles,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.features.encoders import WeightsSource

SUFFIXES = (".png", ".jpg", ".pdf", ".svg")
app = App(
    name="saliency",
    help_epilogue="""\
example:
  surgicai-vision saliency released:grasp --seed 20003 --step 0,30,60 --out saliency.png""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `saliency`.

    Attributes:
        policy: A policy that sees images: a checkpoint folder, released:NAME (see `policies`) or
            module:factory.
        task: The task.
        seed: Seed of the start.
        step: Control steps at which to hide parts of the images.
        patch: Side of the hidden square [px]; squares lie half a side apart.
        out: Image to write.
    """

    policy: Annotated[str, Parameter(metavar="POLICY")] = field(kw_only=False)
    task: PolicyTask = None
    seed: Annotated[int, SEED] = names.TEST_SEED
    step: Annotated[tuple[int, ...], WHOLE_NUMBERS] = (0, 20, 40, 60)
    patch: Annotated[int, within(2, 960), Parameter(metavar="PX")] = 32
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    detector: DetectorName = None
    out: Annotated[Path, Parameter(metavar="FILE")] = Path("saliency.png")
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Run one episode, hide parts of the images at some steps, and draw what mattered."""
    from surgicai_vision.envs import contact_sheet
    from surgicai_vision.evaluation.occlusion import occlusion

    folders.check_file(options.out, "--out", SUFFIXES)
    spec = open_given(
        console,
        options.policy,
        options.task,
        options.env,
        None,
        WeightsSource.parse(options.weights, options.accept_licence),
        detector=options.detector,
    )
    with console.stage("hiding parts of images"):
        found = occlusion(spec.make_agent(), spec.config, options.seed, options.step, options.patch)
    ended = f"{'success' if found.success else 'failure'} after {found.steps} steps"
    title = f"{spec.name}: {spec.config.task}, start {options.seed}, {ended}"
    contact_sheet.write(found.sheet(title), options.out, dpi=100)
    console.say(f"{ended}; an action changes by up to {found.largest:.2f} of its range")
    console.say(f"image: {options.out}")
    return {
        "policy": spec.name,
        "task": spec.config.task,
        "success": found.success,
        "steps": found.steps,
        "largest": found.largest,
        "image": str(options.out),
    }
