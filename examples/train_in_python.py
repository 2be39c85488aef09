"""From demonstrations to a measured success rate, without the command line.

python examples/train_in_python.py --task place --demonstrations 50 --episodes 20
"""

import argparse
from pathlib import Path

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


def main() -> None:
    """Do all of it in one folder; steps that are already done are skipped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="place")
    parser.add_argument("--demonstrations", type=int, default=50)
    parser.add_argument("--encoder", default="imagenet-lite")
    parser.add_argument("--epochs", type=int, help="training epochs; default: the recipe's")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--workers", type=int, help="processes; default: one per core")
    arguments = parser.parse_args()

    out = Path("outputs/train_in_python")
    folder = prepare_dataset(  # records and renders
        TaskConfig(arguments.task),
        out,
        RunContext(arguments.workers),
        demonstrations=arguments.demonstrations,
        views=("front",),
        size=224,
        depth=False,
    )

    # A run is plain data. These two differ only in whether the policy sees images.
    changes = with_epochs((), arguments.epochs)
    dataset = open_dataset(folder)
    sees = RunConfig(dataset.config, arguments.encoder, ("front",), changes=changes)
    blind = RunConfig(dataset.config, changes=changes)

    # Held-out starts: training draws its seeds from another range, so they never overlap.
    starts = range(TEST_SEED, TEST_SEED + arguments.episodes)
    for run in (sees, blind):
        checkpoint = out / "policies" / run.name
        train_run(run, dataset, checkpoint, silent_stage)  # encodes first, or uses the cache
        result = evaluate_into(out / "evaluations" / run.name, open_policy(checkpoint), starts)
        low, high = result["ci95"]
        print(f"{run.name}: {result['successes']}/{result['episodes']} ({low:.2f}–{high:.2f})")


if __name__ == "__main__":  # spawned workers import this file
    main()
