"""Train a detector.

    card = train_detector([Path("demos/place"), Path("demos/insert")], Path("detector"))

One call renders the examples (`examples`), trains the network and writes the folder. A run that was
killed continues: rendered examples are kept in `<out>.work`, and the training resumes after its
last epoch. A finished folder of the same request is left as it is.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray

from surgicai_vision.core.config import JSON
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext, building, claim
from surgicai_vision.core.files import check_output, code_version, whole_folder
from surgicai_vision.demos.store import demos_digest, distinct_folders, list_demos
from surgicai_vision.detection.card import (
    CAMERAS,
    CARD,
    EPOCHS,
    PER_DEMO,
    DetectorCard,
    read_card,
)
from surgicai_vision.detection.detector import tensor_of, write_detector
from surgicai_vision.detection.examples import Examples, are_shown, distances, render_examples
from surgicai_vision.detection.network import JawNetwork, loss, read_places
from surgicai_vision.training.folder import read_state, write_state
from surgicai_vision.training.threads import one_thread

BATCH = 64
LEARNING_RATE = 0.003
"""The peak of a cycle."""
WEIGHT_DECAY = 1e-4
HELD_OUT = 0.05
"""Share of the demonstrations whose examples measure the errors and are not trained on."""


def train_detector(
    demos: Sequence[Path],
    out: Path,
    *,
    cameras: Sequence[str] = CAMERAS,
    per_demo: int = PER_DEMO,
    epochs: int = EPOCHS,
    seed: int = 0,
    context: RunContext = RunContext(),
) -> DetectorCard:
    """Render examples of demonstrations and train a detector on them.

    Args:
        demos: folders of demonstrations of any tasks, all of one scene each.
        out: the detector's folder to create.
        cameras: cameras whose whole images it is to know; crops are not cameras.
        per_demo: states of each demonstration to render.
        epochs: passes over the images.
        seed: training seed.
        context: workers, engine and display.

    Raises:
        InputError: fewer than two demonstrations, or a folder given twice.
        OutputExists: `out` holds something else.
    """
    paths = [path for folder in distinct_folders(demos) for path in list_demos(folder)]
    if len(paths) < 2:
        raise InputError(
            f"There is {len(paths)} demonstration; a detector needs at least 2, one of them to "
            "measure its errors."
        )
    made_of = demos_digest(paths)
    if (out / CARD).is_file():
        card = read_card(out)
        states = per_demo if card.per_demo is None else card.per_demo
        same = (tuple(cameras), made_of, epochs, seed, per_demo)
        if (card.cameras, card.demos, card.epochs, card.seed, states) != same:
            raise OutputExists(
                f"--out {out} holds another detector; give a folder that does not exist yet."
            )
        return card
    check_output(out)
    with building(out) as (store, result), claim(store):
        with context.stage(f"examples: {', '.join(cameras)}", "images") as progress:
            examples = render_examples(paths, store, cameras, per_demo, context, progress)
        request: dict[str, JSON] = {
            "cameras": list(cameras),
            "demos": made_of,
            "per_demo": per_demo,
            "epochs": epochs,
            "seed": seed,
            "code": code_version("detection"),
        }
        fit = _Fit(examples, len(cameras), epochs, seed)
        with context.stage("training the detector", "epochs") as progress, one_thread():
            fit.resume(store, request)
            progress(fit.epoch, epochs)
            while fit.epoch < epochs:
                fit.run_epoch()
                write_state(store, {"request": request, **fit.state()})
                progress(fit.epoch, epochs)
            errors = fit.errors()
        card = DetectorCard(
            tuple(cameras),
            made_of,
            len(fit.rows),
            epochs,
            seed,
            dict(zip(cameras, errors, strict=True)),
            code_version("detection"),
            per_demo=per_demo,
        )
        with whole_folder(result) as folder:
            write_detector(folder, card, fit.network)
    return read_card(out)


@final
class _Fit:
    """One training: its examples, its network, its optimiser.

    Args:
        examples: all of them; those of a random `HELD_OUT` of the demonstrations are not trained
            on.
        cameras: number of cameras.
        epochs: passes over the images.
        seed: training seed.
    """

    def __init__(self, examples: Examples, cameras: int, epochs: int, seed: int):
        rng = np.random.default_rng((seed, 0))
        count = int(examples.demos[-1]) + 1
        held = rng.permutation(count)[: max(1, round(HELD_OUT * count))]
        is_held = np.isin(examples.demos, held)
        self.examples = examples
        self.rows: NDArray[np.int64] = np.flatnonzero(~is_held)
        self.held: NDArray[np.int64] = np.flatnonzero(is_held)
        self.epoch = 0
        self._cameras = cameras
        self._order = np.random.default_rng((seed, 1))
        torch.manual_seed(seed)
        # In this layout, which `tensor_of` has, an update takes half the time on a CPU.
        self.network = JawNetwork(cameras)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY
        )
        steps = epochs * len(range(0, len(self.rows), BATCH))
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimiser, LEARNING_RATE, total_steps=steps
        )

    def run_epoch(self) -> None:
        """Pass over the training images once."""
        self.network.train()
        order = self._order.permutation(self.rows)
        for start in range(0, len(order), BATCH):
            rows = np.sort(order[start : start + BATCH])
            self._optimiser.zero_grad(set_to_none=True)
            loss(self._answers(rows), torch.from_numpy(self.examples.places[rows])).backward()
            self._optimiser.step()
            self._schedule.step()
        self.epoch += 1

    def errors(self) -> list[float]:
        """Return each camera's median error on the held-out images, as a share of their height."""
        self.network.eval()
        medians = []
        for camera in range(self._cameras):
            rows = self.held[self.examples.cameras[self.held] == camera]
            with torch.inference_mode():
                found = [
                    read_places(self._answers(rows[start : start + BATCH]))[0]
                    for start in range(0, len(rows), BATCH)
                ]
            true = self.examples.places[rows]
            off = distances(torch.cat(found).numpy(), true)
            medians.append(float(np.median(off[are_shown(true)])))
        return medians

    def state(self) -> dict[str, object]:
        """Return what a training resumes from."""
        return {
            "epoch": self.epoch,
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "schedule": self._schedule.state_dict(),
        }

    def resume(self, store: Path, request: dict[str, JSON]) -> None:
        """Continue a training of the same request that was killed."""
        state = read_state(store)
        if state is None or state["request"] != request:
            return
        self.epoch = state["epoch"]
        self.network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._schedule.load_state_dict(state["schedule"])
        for _ in range(self.epoch):
            self._order.permutation(self.rows)

    def _answers(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """Return the network's answers for some images."""
        images = tensor_of(self.examples.images[rows])
        answers: torch.Tensor = self.network(images, torch.from_numpy(self.examples.cameras[rows]))
        return answers
