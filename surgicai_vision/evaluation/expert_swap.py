"""Expert swap: how far a hierarchical policy gets when the expert does one of its subtasks.

`evaluate_swaps` evaluates the policy as it is and with each subtask given to the expert in turn,
on the same starts, one evaluation folder per variant. It writes `expert_swap.parquet`: for every
variant and subtask, the number of episodes that finished it and all before it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from surgicai_vision.core import files, names
from surgicai_vision.core.config import JSON, to_mapping
from surgicai_vision.core.progress import Stage
from surgicai_vision.evaluation.hierarchical_config import read_hierarchical
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.rollout import check_seeds
from surgicai_vision.evaluation.run import check_scene, evaluate_into
from surgicai_vision.evaluation.statistics import clopper_pearson, holm, mcnemar
from surgicai_vision.evaluation.storage import MARKER, Row, parquet_bytes, read_rows
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource

CURVES, MARK = "expert_swap.parquet", "expert_swap.json"
EXPERT, AS_IT_IS = "expert", "as-it-is"


def variants_of(
    path: Path, env: Mapping[str, JSON] | None = None, weights: WeightsSource = ANYWHERE
) -> dict[str, PolicySpec]:
    """Return the policy as it is, then with the expert in each subtask that it does not do already.

    Args:
        path: the YAML file of a hierarchical policy.
        env: fields of the env that differ, as `open_policy` takes them.
        weights: where pretrained weights come from.

    Returns:
        Folder name → what is evaluated.
    """
    learned = [name for name, acts in read_hierarchical(path).low.items() if acts != EXPERT]
    swaps = {
        subtask: open_policy(path, env=env, expert_swap=subtask, weights=weights)
        for subtask in learned
    }
    return {AS_IT_IS: open_policy(path, env=env, weights=weights), **swaps}


def evaluate_swaps(
    variants: Mapping[str, PolicySpec],
    seeds: Sequence[int],
    out: Path,
    stage: Stage,
    workers: int | None = None,
) -> list[Row]:
    """Evaluate every variant into `out`, and return the rows of `expert_swap.parquet`.

    Existing results are kept, so running again continues.

    Args:
        variants: folder name → what is evaluated, from `variants_of`.
        seeds: start seeds, the same for all.
        out: folder to make or to continue.
        stage: shows progress.
        workers: processes.

    Raises:
        InputError: seeds that `check_seeds` refuses.
        OutputExists: `out` holds another policy, other starts or another scene.
    """
    check_seeds(seeds)
    _claim(out, variants[AS_IT_IS], seeds)
    check_scene(out, variants[AS_IT_IS].config.scene, "expert swaps")
    successes: dict[str, list[bool]] = {}
    rows: list[Row] = []
    for name, spec in variants.items():
        folder = out / name
        if not (folder / MARKER).exists():
            with stage(f"{name}: {spec.name}", "steps") as progress:
                evaluate_into(folder, spec, seeds, workers, progress)
        episodes = read_rows(folder)
        successes[name] = [bool(row["success"]) for row in episodes]
        rows += _stages(spec.run.expert_swap or "", [row["stages"] for row in episodes])
    others = [name for name in variants if name != AS_IT_IS]
    p_values = [mcnemar(successes[AS_IT_IS], successes[name]) for name in others]
    found = dict(zip(others, zip(p_values, holm(p_values), strict=True), strict=True))
    for row in rows:
        row["p"], row["p_holm"] = found.get(row["expert_swap"], (None, None))
    files.write_bytes(out / CURVES, parquet_bytes(rows))
    return rows


def _stages(expert_swap: str, stages: Sequence[int]) -> list[Row]:
    """Return how many episodes finished each subtask and all before it."""
    rows: list[Row] = []
    for index, subtask in enumerate(names.SUBTASKS):
        k = sum(stage > index for stage in stages)
        n = len(stages)
        low, high = clopper_pearson(k, n)
        rows.append(
            {
                "expert_swap": expert_swap,
                "stage": index + 1,
                "subtask": subtask,
                "k": k,
                "n": n,
                "low": low,
                "high": high,
            }
        )
    return rows


def _claim(out: Path, spec: PolicySpec, seeds: Sequence[int]) -> None:
    """Record in `out` which policy is evaluated on which starts; refuse another one's folder."""
    mine = {
        "hierarchical": spec.about["hierarchical"],
        "task_config": to_mapping(spec.config),
        **spec.content,
        "seeds": [int(seed) for seed in seeds],
    }
    files.claim(out / MARK, mine, "the expert swaps")
