"""Your own encoder, used like the built-in ones: a 16 × 16 thumbnail.

python examples/own_encoder.py --demonstrations 20 --episodes 10
"""

import argparse
from pathlib import Path

from torch import nn

import surgicai_vision
from encoders.base import EncoderCard, Plugin
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.names import TEST_SEED
from surgicai_vision.core.progress import silent_stage
from surgicai_vision.dataset import open_dataset
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.run import evaluate_into
from surgicai_vision.experiments.prepare import prepare_dataset
from surgicai_vision.experiments.run import train_run
from surgicai_vision.training.run_config import RunConfig, with_epochs

CARD = EncoderCard(  # where the encoder comes from, and which input it expects
    name="thumbnail", architecture="mean over 16 × 16 squares", dim=3 * 16 * 16, paper="none",
    source="seed", revision="1", filename=None, sha256=None, licence="MIT", offline=True,
    input_size=224, input_range=(0.0, 1.0), mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25),
    interpolation="bilinear",
)  # fmt: skip


def build(card: EncoderCard, weights: Path | None) -> tuple[EncoderCard, nn.Module]:
    """Return the network: (B, 3, 224, 224) normalised images → (B, 768)."""
    return card, nn.Sequential(nn.AvgPool2d(224 // 16), nn.Flatten())


# At the top level, so that worker processes, which import this file, know the encoder too.
surgicai_vision.register_encoder("thumbnail", Plugin(CARD, build))

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--demonstrations", type=int, default=20)
    parser.add_argument("--epochs", type=int, help="training epochs; default: the recipe's")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--workers", type=int, help="processes; default: one per core")
    arguments = parser.parse_args()
    out, context = Path("outputs/own_encoder"), RunContext(arguments.workers)
    count, changes = arguments.demonstrations, with_epochs((), arguments.epochs)

    run = RunConfig(TaskConfig("place"), encoder="thumbnail", views=("front",), changes=changes)
    folder = prepare_dataset(
        run.env, out, context, demonstrations=count, views=run.views, size=224, depth=False
    )
    train_run(run, open_dataset(folder), out / "policy", silent_stage)
    starts = range(TEST_SEED, TEST_SEED + arguments.episodes)
    result = evaluate_into(out / "evaluation", open_policy(out / "policy"), starts)
    print(f"{run.name}: {result['successes']}/{result['episodes']}, 95 % {result['ci95']}")
