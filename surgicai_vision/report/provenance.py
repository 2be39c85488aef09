"""Provenance: with what, where and by which commands the numbers were produced."""

import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from surgicai_vision.core.banks import USES, bank_of
from surgicai_vision.core.words import plural
from surgicai_vision.report import text
from surgicai_vision.report.groups import Group
from surgicai_vision.report.reader import Collected, Result
from surgicai_vision.report.tables import evaluate_command

FLOW = ("demos", "dataset", "features", "policy", "evaluation", "report")


def origin(collected: Collected, groups: Sequence[Group]) -> dict[str, object]:
    """Return versions, seeds, machine, renderer and hashes; every value where cells differ."""
    run = collected.run
    results = collected.results
    made = [run["provenance"]] if run.get("provenance") else []
    made += [result.about["provenance"] for result in results if result.about.get("provenance")]
    facts = [
        ("data", run.get("data")),
        ("time", stages(run.get("seconds", {}))),
        ("starts", _starts(results)),
        ("training seeds", _distinct(result.seed for result in results if result.trained)),
        ("versions", _distinct(map(_versions, made), "; ")),
        ("Python", _distinct(one.get("python") for one in made)),
        ("machine", _distinct(map(_machine, made), "; ")),
        ("GL renderer", _distinct(one.get("renderer") for one in made)),
        ("scene, sha256", _distinct(result.about.get("scene_hash") for result in results)),
    ]
    known = [command for result in results if (command := result.about.get("command"))]
    return {
        "command": run.get("command") or (known[0] if known else None),
        "facts": [(name, value) for name, value in facts if value],
        "cells": [_cell(item, result) for item in groups for result in item.results],
    }


def commands(result: Result, run: dict[str, Any]) -> list[str]:
    """Return the commands that reproduce a cell's number.

    One uses the stored policy; the other starts from scratch.
    """
    found = [evaluate_command(result), result.about.get("command") or run.get("command")]
    return list(dict.fromkeys(command for command in found if command))


def stages(seconds: dict[str, float]) -> str:
    """Say where the time went; `seconds` maps a stage's name to its time [s]."""
    ordered = sorted(
        seconds.items(), key=lambda item: FLOW.index(item[0]) if item[0] in FLOW else len(FLOW)
    )
    parts = [f"{name} {value:.0f} s" for name, value in ordered]
    return f"{sum(seconds.values()):.0f} s: {', '.join(parts)}" if parts else ""


def _cell(item: Group, result: Result) -> dict[str, str | int]:
    """Return one row of the table of hashes."""
    checkpoint = result.checkpoint
    command = evaluate_command(result) or str(result.about.get("command") or "")
    return {
        "task": item.condition.task,
        "policy": item.label,
        "seed": result.seed if result.trained else text.ABSENT,
        "weights": _hash(checkpoint.get("weights_sha256")),
        "sha256": _hash(checkpoint.get("policy_sha256")),
        "dataset": _hash(checkpoint.get("dataset") or result.about.get("dataset")),
        "command": _one_line(command) if command else text.ABSENT,
    }


def _one_line(command: str) -> str:
    """Return a command without shell quotes, or unchanged if no shell can parse it."""
    try:
        return " ".join(shlex.split(command))
    except ValueError:
        return command


def _hash(value: object) -> str:
    return str(value)[:16] if value else text.ABSENT


def _starts(results: Sequence[Result]) -> str:
    """Return the range of start seeds of each bank, how many of them, and what the bank is for."""
    found: dict[str, list[int]] = {}
    for seed in sorted({row["seed"] for result in results for row in result.rows}, reverse=True):
        found.setdefault(bank_of(seed), []).insert(0, seed)
    return "; ".join(
        f"{seeds[0]}–{seeds[-1]} ({plural(len(seeds), 'start')}), {USES[bank]}"
        for bank, seeds in found.items()
    )


def _distinct(values: Iterable[object], joint: str = ", ") -> str:
    """Join different values in the order of their first appearance."""
    return joint.join(dict.fromkeys(str(value) for value in values if value not in (None, "")))


def _versions(made: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {number}" for name, number in (made.get("packages") or {}).items() if number
    )


def _machine(made: dict[str, Any]) -> str:
    return (
        f"{made['processor']}, {made.get('cores')} cores, {made.get('system')}"
        if made.get("processor")
        else ""
    )
