"""Features and actions → policy.

Interface:

* `train(dataset, features, policy, recipe, seed=…, out=…, progress=…) -> Checkpoint`: train from
  the feature cache. Running it again goes on where it was broken off, or returns what is done.
* `epochs_within(minutes, …)`: how many epochs fit into a budget.
* What is asked of a training: `surgicai_vision.training.request`; its epochs: `loop`; what it reads
  of a dataset, its split and its batches: `data`.

Layout of the folder while it trains; the first and the last two stay (see
`surgicai_vision.training.checkpoint`):

    training.json          what was asked for; marks the folder as ours
    training_state.pt      weights, optimiser and random state every few epochs
    epochs/epoch_0010/     a complete checkpoint every `save_every` epochs, when asked for
    policy.safetensors     weights and the statistics of the inputs
    checkpoint.json        everything about them, with their hash; written last

The split is by episode unless the recipe says otherwise. The validation loss is reported and
chooses nothing: the last epoch is the checkpoint. The same seed gives the same weights on one
machine.
"""

import ctypes
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from policies.base import Plugin, Policy, Recipe
from surgicai_vision.core.progress import Progress
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.features.cache import Features
from surgicai_vision.features.devices import cuda_devices
from surgicai_vision.training.checkpoint import Checkpoint
from surgicai_vision.training.folder import begin, remove_state
from surgicai_vision.training.loop import Log, Training
from surgicai_vision.training.request import TrainingRequest, check_request, request_table
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.threads import one_thread

TRIM_THRESHOLD = -1  # of malloc.h, as is the next
MMAP_THRESHOLD = -3


def train(
    dataset: Dataset,
    features: Sequence[Features],
    policy: Plugin,
    recipe: Recipe,
    *,
    seed: int = 0,
    out: Path,
    progress: Progress | None = None,
    run: RunConfig | None = None,
    save_every: int = 0,
    start: Policy | None = None,
    progress_policy: Checkpoint | None = None,
    device: str = "cpu",
    log: Log | None = None,
) -> Checkpoint:
    """Train a policy and write its checkpoint.

    Args:
        dataset: an opened dataset.
        features: one entry of the cache per view, in the order the policy is to see them; none for
            proprioception alone.
        policy: a `policies.base.Plugin`.
        recipe: an instance of `policy.recipe`.
        seed: of the initialisation, the split and the order of frames.
        out: the checkpoint folder; new, or one of the same request, which is then continued.
        progress: called with (epochs done, epochs in all).
        run: what is trained, stored in the checkpoint with what this training knows better: its
            task, inputs and number of demonstrations.
        save_every: also keep a checkpoint every so many epochs; 0 keeps the last alone.
        start: a trained policy with the same inputs to start from (fine-tuning).
        progress_policy: checkpoint of the policy that said the dataset's progress
            (`training.progress_input`), where the recipe feeds it; it is copied into `out`.
        device: torch device to train on.
        log: called with (epoch, losses by name) after each epoch.

    Raises:
        InputError: features of another dataset or of several encoders, or nothing to train on.
        OutputExists: `out` holds something else.
        SurgicaiError: the loss is not finite.
    """
    run = run or RunConfig(recipe="custom")
    request = TrainingRequest(dataset, tuple(features), policy, recipe, seed, run, progress_policy)
    out = Path(out)
    check_request(request)
    if done := begin(out, request_table(request, start)):
        return done
    _keep_memory()
    where = torch.device(device)
    with _repeatable(where):
        checkpoint = Training(request, start, where).run(out, save_every, progress, log)
    remove_state(out)
    return checkpoint


def epochs_within(
    minutes: float,
    dataset: Dataset,
    features: Sequence[Features],
    policy: Plugin,
    recipe: Recipe,
    *,
    seed: int = 0,
    device: str = "cpu",
) -> int:
    """Return how many epochs fit into so many minutes of one core, at least 1.

    A few updates are made and timed by the processor's clock, so that other processes do not count;
    what they learn is thrown away. On a GPU it is the wall's clock.
    """
    request = TrainingRequest(
        dataset, tuple(features), policy, recipe, seed, RunConfig(recipe="custom")
    )
    check_request(request)
    _keep_memory()
    where = torch.device(device)
    clock = time.process_time if where.type == "cpu" else time.perf_counter
    with _repeatable(where):
        begun = clock()
        training = Training(request, None, where)
        prepared = clock() - begun
        seconds = training.time_epoch(clock)
    return max(1, int((60 * minutes - prepared) / seconds))


@contextmanager
def _repeatable(device: torch.device) -> Iterator[None]:
    """Let the same seed give the same weights, and the caller's random numbers be as they were.

    On a GPU that takes kernels that sum in a fixed order.
    """
    fixed_order = torch.backends.cudnn.flags(enabled=True, deterministic=True)
    with torch.random.fork_rng(devices=cuda_devices(device)), one_thread(), fixed_order:
        yield


def _keep_memory() -> None:
    """Let glibc keep what is freed.

    A batch of feature maps is allocated anew each step, and handing its pages back and forth costs
    1.5 times the arithmetic (221 against 84 ms of CPU a step of 256 maps of 48 × 28 × 28).
    """
    with suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, 1 << 30)
        mallopt(TRIM_THRESHOLD, (1 << 31) - 1)
