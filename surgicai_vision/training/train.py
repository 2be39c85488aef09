"""Features and actions → policy.

Interface:

* `train(dataset, features, policy, recipe, seed=…, out=…, progress=…) -> Checkpoint`: train from
  the feature cache. Running it again resumes an interrupted training, or returns a finished one.
* `epochs_within(minutes, …)`: how many epochs fit into a budget.
* The request of a training is in `surgicai_vision.training.request`, its epochs are in `loop`, its
  columns, split and batches in `data`.

Layout of the folder during training; the first and the last two files stay (see
`surgicai_vision.training.checkpoint`):

    training.json          the request; marks the folder as ours
    training_state.pt      weights, optimiser and random state every few epochs
    epochs/epoch_0010/     a complete checkpoint every `save_every` epochs, if requested
    policy.safetensors     weights and the statistics of the inputs
    checkpoint.json        everything about them, with their hash; written last

The split is by episode unless the recipe says otherwise. The validation loss is only reported: the
checkpoint is always that of the last epoch. The same seed gives the same weights on one machine.
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
from surgicai_vision.training.folder import training_in
from surgicai_vision.training.loop import Log, Training
from surgicai_vision.training.request import TrainingRequest, check_request, request_table
from surgicai_vision.training.run_config import RunConfig
from surgicai_vision.training.threads import one_thread

TRIM_THRESHOLD = -1  # from malloc.h, like the next
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
        seed: seed of the initialisation, the split and the order of frames.
        out: the checkpoint folder; new, or one of the same request, which is then resumed.
        progress: called with (epochs done, epochs in total).
        run: the run, stored in the checkpoint; this training fills in its task, inputs and number
            of demonstrations.
        save_every: also keep a checkpoint after every this many epochs; 0 keeps only the last.
        start: a trained policy with the same inputs to start from (fine-tuning).
        progress_policy: checkpoint of the policy that predicted the dataset's progress
            (`training.progress_input`), if the recipe feeds it; it is copied into `out`.
        device: torch device to train on.
        log: called with (epoch, losses by name) after each epoch.

    Raises:
        InputError: features of another dataset or of several encoders, nothing to train on, or
            another process that trains into `out`.
        OutputExists: `out` holds something else.
        SurgicaiError: the loss is not finite.
    """
    run = run or RunConfig(recipe="custom")
    request = TrainingRequest(dataset, tuple(features), policy, recipe, seed, run, progress_policy)
    out = Path(out)
    check_request(request)
    with training_in(out, request_table(request, start)) as done:
        if done is not None:
            return done
        _keep_memory()
        where = torch.device(device)
        with _repeatable(where):
            return Training(request, start, where).run(out, save_every, progress, log)


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
    """Return how many epochs fit into `minutes` of one core, at least 1.

    A few updates are made and timed in CPU time, so that other processes do not count; their result
    is discarded. On a GPU, wall-clock time is used.
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
    """Make the same seed give the same weights, and leave the caller's random state unchanged.

    On a GPU this requires kernels that sum in a fixed order.
    """
    fixed_order = torch.backends.cudnn.flags(enabled=True, deterministic=True)
    with torch.random.fork_rng(devices=cuda_devices(device)), one_thread(), fixed_order:
        yield


def _keep_memory() -> None:
    """Make glibc keep freed memory.

    A batch of feature maps is allocated anew at each step, and returning its pages to the system
    costs 1.5 times the arithmetic (221 against 84 ms of CPU per step of 256 maps of 48 × 28 × 28).
    """
    with suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, 1 << 30)
        mallopt(TRIM_THRESHOLD, (1 << 31) - 1)
