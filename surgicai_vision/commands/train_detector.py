"""`train-detector`: train a detector of the jaws, by which crops can be aimed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import COUNT, DIRECTORY, EXECUTOR, SEED, UNIQUE
from surgicai_vision.core.cameras import camera_names, check_camera
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.words import plural
from surgicai_vision.detection.card import CAMERAS, CARD, EPOCHS, PER_DEMO

app = App(
    name="train-detector",
    help_epilogue="""\
example:
  surgicai-vision train-detector --demos outputs/demos/place
then, with a policy that sees crops:
  surgicai-vision robustness released:place --axis camera --detector outputs/detector""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `train-detector`.

    Attributes:
        demos: One or more folders of demonstrations, of any tasks.
        camera: Cameras whose whole images it is to know; a crop is aimed in its camera's image.
        per_demo: Number of states of each demonstration to render.
        epochs: Number of passes over the images.
        seed: Training seed.
        workers: Number of processes that render.
        out: Folder of the detector to create or continue.
    """

    demos: Annotated[tuple[Path, ...], Parameter(metavar="DIR[,DIR]")]
    camera: Annotated[tuple[str, ...], UNIQUE, Parameter(metavar="CAMERA[,CAMERA]")] = CAMERAS
    per_demo: Annotated[int, COUNT] = PER_DEMO
    epochs: Annotated[int, COUNT] = EPOCHS
    seed: Annotated[int, SEED] = 0
    workers: Annotated[int, COUNT] = folders.CORES
    executor: Annotated[str, EXECUTOR] = "local"
    out: Annotated[Path, DIRECTORY] = folders.OUTPUTS / "detector"


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Render examples, train the detector and print how far off it is."""
    from surgicai_vision.core.executor import LOCAL, RunContext, open_engine
    from surgicai_vision.detection.examples import can_be_aimed
    from surgicai_vision.scene.cameras import crop_of
    from surgicai_vision.scene.opengl import check_opengl

    context = RunContext(options.workers, open_engine(options.executor), console.stage)
    crops = [crop for crop in map(crop_of, camera_names()) if crop is not None]
    aimable = dict.fromkeys(crop.camera for crop in crops if can_be_aimed(crop))
    for camera in options.camera:
        check_camera(camera)
        crop = crop_of(camera)
        if crop is not None:
            raise InputError(
                f"--camera {camera} is a crop, which shows only what lies about the reported jaws; "
                f"give its camera, {crop.camera}."
            )
        if camera not in aimable:
            raise InputError(
                f"--camera {camera}: a detector aims crops of 4:3 images, and this camera has "
                f"none; allowed: {', '.join(aimable)}."
            )
    for folder in options.demos:
        folders.demos_task(folder)
    folders.check_folder(options.out, CARD)
    if context.engine == LOCAL:  # with other engines the workers must be able to draw
        check_opengl()
    from surgicai_vision.detection.fit import train_detector

    card = train_detector(
        options.demos,
        options.out,
        cameras=options.camera,
        per_demo=options.per_demo,
        epochs=options.epochs,
        seed=options.seed,
        context=context,
    )
    for camera in card.cameras:
        console.say(
            f"{camera}: the jaws found {card.errors[camera]:.1%} of the image's height off "
            "(median, held-out demonstrations)"
        )
    console.say(f"detector, {plural(card.images, 'image')}: {options.out}")
    return {
        "cameras": list(card.cameras),
        "errors": dict(card.errors),
        "images": card.images,
        "detector": str(options.out),
    }
