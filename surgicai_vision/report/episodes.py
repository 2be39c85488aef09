"""Episodes: what a click on a cell shows.

Every episode's outcome, the commands, hashes and film strips.
"""

import hashlib
import json
from collections.abc import Sequence

from markupsafe import Markup

from surgicai_vision.core import percentages
from surgicai_vision.evaluation.statistics import clopper_pearson
from surgicai_vision.report import text
from surgicai_vision.report.charts import KIND_COLOURS
from surgicai_vision.report.filmstrips import Reel, Strip
from surgicai_vision.report.groups import MEASURES, Group
from surgicai_vision.report.reader import Result

LETTERS = {
    "": "s",
    "missed": "m",
    "dropped": "d",
    "wrong_hole": "w",
    "time": "t",
    "physics": "p",
    "error": "e",
}
"""Outcome of an episode → its letter in the page's data."""

_DARK_TEXT = ("dropped", "time", "missed")
"""Outcomes whose colour is too light for white letters."""


def letters() -> Markup:
    """Return what each letter means and its colour, as JSON for a script element."""
    kinds = {
        letter: {
            "name": (kind or "success").replace("_", " "),
            "colour": KIND_COLOURS[kind or "success"],
            "dark": kind in _DARK_TEXT,
        }
        for kind, letter in LETTERS.items()
    }
    return Markup(json.dumps(kinds))


def film_id(identity: tuple[str, int]) -> str:
    """Return the name of an episode's film on the page."""
    return "film-" + hashlib.sha256(repr(identity).encode()).hexdigest()[:12]


def group_details(
    item: Group, reel: Reel, commands: dict[str, list[str]], on_page: set[tuple[str, int]]
) -> dict[str, object]:
    """Return the details of one condition.

    They are its cells with their episodes, its films, what was measured and what is missing.

    Args:
        item: the condition.
        reel: all strips of the page.
        commands: folder of a result → the commands that reproduce its number.
        on_page: episodes whose frames are in the page already; here they are only named.
    """
    films = []
    for index, result in enumerate(item.results):
        for row in result.rows:
            strip = reel.strips.get((str(result.folder), row["seed"]))
            if strip is not None:
                films.append({"cell": index, "start": row["seed"], **_film(strip, on_page)})
    return {
        "title": item.label,
        "task": item.condition.task,
        "count": f"{item.successes}/{item.episodes}" if item.episodes else "",
        "interval": percentages.interval(item.interval) if item.episodes else "",
        "across": item.across_text() if item.across else "",
        "cells": [_cell(result, commands.get(str(result.folder), [])) for result in item.results],
        "measures": _measures(item) if item.episodes else [],
        "missing": [
            {"seed": cell.seed, "state": cell.state, "reason": cell.reason} for cell in item.missing
        ],
        "films": films,
    }


def _cell(result: Result, commands: Sequence[str]) -> dict[str, object]:
    """Return one training seed: counts, episodes in short form, facts."""
    rows = result.rows
    k = sum(bool(row["success"]) for row in result.rows)
    return {
        "seed": result.seed if result.trained else None,
        "count": f"{k}/{len(rows)}",
        "interval": percentages.interval(clopper_pearson(k, len(rows))),
        "starts": _starts([row["seed"] for row in rows]),
        "outcomes": "".join(
            "s" if row["success"] else LETTERS.get(row["failure"], "?") for row in rows
        ),
        "steps": [row["steps"] for row in rows],
        "mm": [_rounded(row.get("d_trans_mm")) for row in rows],
        "deg": [_rounded(row.get("d_angle_deg")) for row in rows],
        "commands": list(commands),
        "facts": _facts(result),
    }


def _starts(seeds: Sequence[int]) -> int | list[int]:
    """Return the first start if they are consecutive, else all of them."""
    in_a_row = list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    return seeds[0] if in_a_row else list(seeds)


def _facts(result: Result) -> list[tuple[str, str]]:
    checkpoint = result.checkpoint
    facts = (
        ("encoder weights, sha256", checkpoint.get("weights_sha256")),
        ("policy, sha256", checkpoint.get("policy_sha256")),
        ("dataset fingerprint", checkpoint.get("dataset") or result.about.get("dataset")),
        ("scene, sha256", result.about.get("scene_hash")),
        ("demonstrations trained on", checkpoint.get("demonstrations")),
    )
    return [(name, str(value)) for name, value in facts if value]


def _measures(item: Group) -> list[tuple[str, str]]:
    """Return what was measured: lengths and steps of successes, medians of the rest."""
    spread = [
        (
            "trajectory length of successes [mm]",
            text.mean(item.on_successes("trajectory_length_mm")),
        ),
        ("time steps of successes", text.mean(item.on_successes("steps"))),
    ]
    for column, what, unit, _ in MEASURES:
        words = text.spread(item.values(column))
        if words != text.ABSENT:
            spread.append((f"{what} [{unit}], median (quartiles)", words))
    return spread


def _film(strip: Strip, on_page: set[tuple[str, int]]) -> dict[str, object]:
    known: dict[str, object] = {
        "id": film_id(strip.choice.identity),
        "view": strip.view,
        "outcome": strip.outcome,
    }
    if strip.choice.identity in on_page:
        return known
    return {**known, "steps": list(strip.steps), "frames": list(strip.frames)}


def _rounded(value: float | None) -> float | None:
    known = text.finite([value])
    return round(known[0], 1) if known else None
