"""Ends sweep: choose `confidence` and `patience` for the ends of a hierarchical policy.

`sweep_ends` evaluates a hierarchical policy with learned ends for every pair of `confidence` and
`patience` on validation starts, one evaluation folder per pair. It writes the best pair as
`DIR/hierarchical.yaml`, which `evaluate` takes. Existing results are kept, so running again
continues.

The best pair completes the most procedures; among equals, it ends the fewest subtasks falsely, then
ends them soonest. Test starts are refused: a policy chosen on them cannot be measured on them.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from surgicai_vision.core import files, names
from surgicai_vision.core.config import JSON, to_mapping
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.progress import Stage
from surgicai_vision.evaluation.hierarchical_config import (
    CONFIDENCES,
    PATIENCES,
    HierarchicalConfig,
    hierarchical_yaml,
    read_hierarchical,
)
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.run import check_scene, evaluate_once
from surgicai_vision.evaluation.storage import Row
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource
from surgicai_vision.training import released
from surgicai_vision.training.run_config import Starts

CHOSEN = "hierarchical.yaml"
"""File with the best pair, in the sweep's folder."""
MARK = "ends.json"
"""File that says what the folder is a sweep of."""


@dataclass(frozen=True)
class Ends:
    """Outcome of one pair of settings.

    Attributes:
        confidence: of `HierarchicalConfig`.
        patience: of `HierarchicalConfig`.
        successes: whole procedures that succeeded.
        episodes: validation starts.
        false_ends: subtasks ended before their measured success, per procedure.
        delay_s: mean over procedures of the median time from measured success to end [s]; None
            where no subtask was ended after its success.
    """

    confidence: float
    patience: int
    successes: int
    episodes: int
    false_ends: float
    delay_s: float | None

    def rank(self) -> tuple[float, float, float]:
        """Return the key by which pairs are sorted; the best pair has the smallest."""
        late = float("inf") if self.delay_s is None else self.delay_s
        return -self.successes, self.false_ends, late


def sweep_ends(
    path: Path,
    starts: Starts,
    out: Path,
    stage: Stage,
    confidences: Sequence[float] = CONFIDENCES,
    patiences: Sequence[int] = PATIENCES,
    env: Mapping[str, JSON] | None = None,
    weights: WeightsSource = ANYWHERE,
    workers: int | None = None,
) -> list[Ends]:
    """Evaluate every pair and write the best into `out`; return them, the best first.

    Args:
        path: the YAML file of a hierarchical policy.
        starts: validation starts, the same for all.
        out: folder to make or to continue.
        stage: shows progress.
        confidences: values of `HierarchicalConfig.confidence`.
        patiences: values of `HierarchicalConfig.patience`.
        env: fields of the env that differ, as `open_policy` takes them.
        weights: where pretrained weights come from.
        workers: processes.

    Raises:
        InputError: privileged ends, test starts, or values that are not allowed.
        OutputExists: `out` holds another policy, other starts or another scene.
    """
    given = read_hierarchical(released.resolve(path))
    if given.termination != "learned":
        raise InputError(
            f"{path} has termination: {given.termination}; only learned ends have a confidence."
        )
    if starts.seeds[-1] >= names.TEST_SEED:
        raise InputError(
            f"Starts {starts.seeds[0]} to {starts.seeds[-1]} reach into the test starts, from "
            f"{names.TEST_SEED} on; choose on validation starts, from {names.VALIDATION_SEED} on."
        )
    configs = [
        dataclasses.replace(given, confidence=confidence, patience=patience)
        for confidence, patience in itertools.product(confidences, patiences)
    ]
    # Without the pair's values: a later call may try other pairs in the same folder.
    policy = {**to_mapping(given), "confidence": None, "patience": None}
    spec = open_policy(path, env=env, weights=weights)
    owner = {
        "hierarchical": policy,
        "env": dict(env or {}),
        "starts": to_mapping(starts),
        **spec.content,
    }
    files.claim(out / MARK, owner, "the ends")
    check_scene(out, spec.config.scene, "ends")
    tried: dict[HierarchicalConfig, Ends] = {}
    for config in configs:
        name = f"confidence-{config.confidence:g}-patience-{config.patience}"
        file = out / f"{name}.yaml"
        files.write_bytes(file, hierarchical_yaml(config))
        opened = functools.partial(open_policy, file, env=env, weights=weights)
        row = evaluate_once(out / name, opened, starts.seeds, stage, workers)
        tried[config] = _ends(config, row)
    best = min(configs, key=lambda config: tried[config].rank())
    files.write_bytes(out / CHOSEN, hierarchical_yaml(best))
    return sorted(tried.values(), key=Ends.rank)


def _ends(config: HierarchicalConfig, summary: Row) -> Ends:
    """Return what an evaluation's summary says about the ends."""
    return Ends(
        config.confidence,
        config.patience,
        summary["successes"],
        summary["episodes"],
        summary["false_ends"]["mean"],
        summary["end_delay_s"]["mean"],
    )
