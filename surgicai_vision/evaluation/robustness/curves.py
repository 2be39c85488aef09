"""Curves: successes of a policy against how far one thing shifts from its training conditions.

`robustness(spec, seeds, out)` evaluates every axis of `axes.AXES`, or those asked for, at every
strength, one evaluation folder each (`<out>/<axis>/<strength>/`). It writes `robustness.parquet`:
one row for every axis and strength with its successes, interval, retention (the share of the plain
successes that is left, on the same starts) and the axis's area under the curve. All strengths use
the same starts, and an episode's shift keeps its direction and grows with the strength, so
strengths are paired. Strength 0 is the plain evaluation.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path

from surgicai_vision.core import files
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError, check_name
from surgicai_vision.core.progress import Stage
from surgicai_vision.envs import check_world
from surgicai_vision.evaluation.policy_spec import PolicySpec
from surgicai_vision.evaluation.robustness import CURVES, MARK, STRENGTHS
from surgicai_vision.evaluation.robustness.axes import AXES, SHIFTS, axes_of, shifted
from surgicai_vision.evaluation.rollout import check_seeds
from surgicai_vision.evaluation.run import check_scene, evaluate_into
from surgicai_vision.evaluation.statistics import (
    area_interval,
    area_under_curve,
    clopper_pearson,
    holm,
    mcnemar,
    retention,
)
from surgicai_vision.evaluation.storage import (
    EPISODES,
    FILMS,
    MARKER,
    VISITS,
    Row,
    find_evaluations,
    parquet_bytes,
    read_evaluation,
    read_rows,
    read_versioned,
)
from surgicai_vision.training.run_config import Shift


def robustness(
    spec: PolicySpec,
    seeds: Sequence[int],
    out: Path,
    stage: Stage,
    axes: Sequence[str] = (),
    strengths: Sequence[float] = STRENGTHS,
    workers: int | None = None,
) -> list[Row]:
    """Evaluate `spec` along every axis into `out` and return their rows of `robustness.parquet`.

    Existing results are kept, so running again continues, also with other axes or strengths. The
    table has every axis and strength that `out` holds.

    Args:
        spec: what is evaluated in which task.
        seeds: start seeds, the same at every strength.
        out: folder to make or to continue.
        stage: shows progress.
        axes: keys of `SHIFTS`; empty takes the `AXES` that change what the policy sees or does
            (`axes_of`).
        strengths: each from 0 to 1, increasing.
        workers: processes.

    Raises:
        UnknownName: an axis that does not exist.
        InputError: strengths out of range or order, seeds that `check_seeds` refuses, an axis of
            images for a policy that sees none, or one that makes its world impossible at the
            largest strength.
        OutputExists: `out` holds the curves of another policy, of other starts or of another scene.
    """
    chosen = _checked(spec, axes, strengths)
    check_seeds(seeds)
    for axis in chosen:
        if SHIFTS[axis].world and not (out / axis / f"{strengths[-1]:g}" / MARKER).exists():
            farthest = shifted(spec, axis, strengths[-1]).config
            check_world(farthest, f"axis {axis} at strength {strengths[-1]:g}")
    _claim(out, spec, seeds)
    check_scene(out, spec.config.scene, "curves")
    places = [out / axis / f"{0.0:g}" for axis in SHIFTS]
    plain = next((place for place in places if (place / MARKER).exists()), None)
    for axis in chosen:
        for strength in strengths:
            folder = out / axis / f"{strength:g}"
            plain = plain or (folder if strength == 0 else None)
            if not (folder / MARKER).exists():
                if strength == 0 and plain is not None and (plain / MARKER).exists():
                    _copy(plain, folder, axis)
                else:
                    with stage(f"{axis} {strength:g}: {spec.name}", "steps") as progress:
                        evaluate_into(
                            folder, shifted(spec, axis, strength), seeds, workers, progress
                        )
    rows: list[Row] = []
    for axis in dict.fromkeys((*chosen, *SHIFTS)):
        stored = _stored(out / axis)
        if stored:
            rows += _curve(axis, list(stored), list(stored.values()))
    _correct(rows)
    files.write_bytes(out / CURVES, parquet_bytes(rows))
    return [row for row in rows if row["axis"] in chosen]


def _stored(folder: Path) -> dict[float, list[bool]]:
    """Return the strengths that were evaluated along one axis, increasing: successes by start."""
    found = {}
    for place in find_evaluations(folder):
        shift = read_evaluation(place).run.shift
        if shift is not None and shift.axis == folder.name:
            found[shift.strength] = [bool(row["success"]) for row in read_rows(place)]
    return dict(sorted(found.items()))


def _checked(spec: PolicySpec, axes: Sequence[str], strengths: Sequence[float]) -> tuple[str, ...]:
    """Return the axes to evaluate; refuse axes or strengths that cannot be."""
    possible = axes_of(spec)
    for axis in axes:
        check_name("axis", axis, SHIFTS)
        if axis in AXES and axis not in possible:
            raise InputError(
                f"{spec.name} sees no images, so '{axis}' changes nothing; "
                f"allowed: {_list(possible)}."
            )
    rising = all(a < b for a, b in itertools.pairwise(strengths))
    if not strengths or not rising or not all(0 <= strength <= 1 for strength in strengths):
        raise InputError(
            f"strengths are {_list(strengths)}; "
            "give numbers from 0 to 1, each larger than the one before."
        )
    return tuple(axes) or possible


def _list(items: Sequence[object]) -> str:
    return ", ".join(map(str, items)) or "none"


def _claim(out: Path, spec: PolicySpec, seeds: Sequence[int]) -> None:
    """Record in `out` what is evaluated on which starts; refuse the folder of something else."""
    mine = {
        "run": to_mapping(spec.run),
        "checkpoint": spec.about.get("checkpoint"),
        "seeds": [int(seed) for seed in seeds],
        **spec.content,
    }
    files.claim(out / MARK, mine, "the curves")


def _copy(plain: Path, folder: Path, axis: str) -> None:
    """Copy the plain evaluation as the one at strength 0 of another axis, which is the same."""
    folder.mkdir(parents=True, exist_ok=True)
    # A kill after the marker was written may have left finished episodes in the folder as well.
    for name in (EPISODES, FILMS, VISITS):
        if (plain / name).exists():
            files.write_bytes(folder / name, (plain / name).read_bytes())
    stored = read_versioned(plain / MARKER)
    stored["run"]["shift"] = to_mapping(Shift(axis, 0.0))
    files.write_json(folder / MARKER, stored)


def _curve(axis: str, strengths: Sequence[float], results: list[list[bool]]) -> list[Row]:
    """Return the rows of one axis; `results` holds the successes by start, for each strength."""
    area: Row = {"auc": None, "auc_low": None, "auc_high": None}
    if len(strengths) > 1:
        # The area is linear in the successes: its mean over the starts' own areas is the curve's.
        areas = [area_under_curve(strengths, start) for start in zip(*results, strict=True)]
        low, high = area_interval(areas)
        area = {"auc": sum(areas) / len(areas), "auc_low": low, "auc_high": high}
    rows = []
    for strength, successes in zip(strengths, results, strict=True):
        low, high = clopper_pearson(sum(successes), len(successes))
        compared = strengths[0] == 0 and strength > 0
        p = mcnemar(results[0], successes) if compared else None
        kept = retention(results[0], successes) if compared else None
        counts = {"k": sum(successes), "n": len(successes), "low": low, "high": high}
        rows.append(
            {
                "axis": axis,
                "strength": float(strength),
                **counts,
                "p": p,
                "p_holm": None,
                "retention": kept.ratio if kept else None,
                "retention_low": kept.low if kept else None,
                "retention_high": kept.high if kept else None,
                **area,
            }
        )
    return rows


def _correct(rows: list[Row]) -> None:
    """Add Holm's correction over all strengths compared with strength 0."""
    compared = [row for row in rows if row["p"] is not None]
    for row, p in zip(compared, holm([row["p"] for row in compared]), strict=True):
        row["p_holm"] = p
