"""A training in stages: learn for some steps, evaluate, keep the best policy, store the state.

    stages = Stages(20_000, save_every=2_500, seed=0, out=out)
    weights, kept = stages.run(model, begun, evaluate, save)

Every stage begins new episodes from its own start seeds, whether or not the training was killed. So
no state of the env needs to be stored.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from surgicai_vision.core import names
from surgicai_vision.core.files import write_json
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.rl.train import CURVE, CurvePoint, Weights, best_point

SEEDS_EACH = 1000
"""Start seeds of one training: one for each stage."""


@dataclass(frozen=True)
class Stages:
    """How long to learn, and how often to evaluate and store.

    Attributes:
        steps: total steps of the model's env.
        save_every: steps of one stage.
        seed: the training seed.
        out: folder of the training; the curve is written there after every stage.
        progress: called with (steps done, steps in total).
    """

    steps: int
    save_every: int
    seed: int
    out: Path
    progress: Progress = silent

    def run[P: CurvePoint](
        self,
        model: BaseAlgorithm,
        begun: tuple[list[P], Weights],
        evaluate: Callable[[float], tuple[P, Weights]],
        save: Callable[[Sequence[P], Weights], None],
    ) -> tuple[Weights, P]:
        """Learn to the end.

        Args:
            model: the model that learns; its `num_timesteps` is its progress.
            begun: the curve so far and the weights of its best point; empty at the start.
            evaluate: CPU minutes of learning so far → the point of the curve, and the weights of
                the policy that was evaluated.
            save: writes the training state of a curve and its best weights.

        Returns:
            The weights of the best point, and that point.
        """
        model.set_logger(Logger(None, []))  # without it `learn` creates a log folder at each call
        curve, best = begun
        minutes = curve[-1].minutes if curve else 0.0
        while model.num_timesteps < self.steps:
            self.progress(model.num_timesteps, self.steps)
            began = time.process_time()
            vector = model.get_env()
            assert vector is not None
            vector.seed(names.TRAIN_SEED + SEEDS_EACH * self.seed + len(curve))
            model._last_obs = None  # new episodes begin
            stage = min(self.save_every, self.steps - model.num_timesteps)
            model.learn(stage, reset_num_timesteps=False)
            minutes += (time.process_time() - began) / 60.0
            point, weights = evaluate(minutes)
            curve.append(point)
            if best_point(curve) is point:
                best = weights
            write_json(self.out / CURVE, [dataclasses.asdict(each) for each in curve])
            if model.num_timesteps < self.steps:
                save(curve, best)
        self.progress(self.steps, self.steps)
        return best, best_point(curve)
