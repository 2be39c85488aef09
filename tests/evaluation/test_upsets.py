"""Evaluations in which one thing goes wrong in every episode."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, PhysicsError
from surgicai_vision.envs.upset import plan_upset
from surgicai_vision.evaluation.agents import ExpertAgent, ZeroAgent
from surgicai_vision.evaluation.metrics import as_table, summary
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.slot import Slot
from surgicai_vision.report.experiment_key import condition_of
from surgicai_vision.training.run_config import RunConfig, of_training

GRASP = TaskConfig("grasp")
SEEDS = [900_000, 900_001, 900_002]


def test_rows_say_what_went_wrong_when_and_whether_it_was_recovered():
    rows = [
        episode.row
        for episode in evaluate(ExpertAgent, GRASP, SEEDS, batch=2, workers=1, upset=True)
    ]
    for row in rows:
        plan = plan_upset(row.seed, "grasp")
        assert plan is not None
        # At the drawn step, or sooner if the jaws come near before.
        assert row.upset == "push" and 0 <= row.upset_step <= plan.wait
        assert row.success and row.recovered
    # The moment depends on the start alone, not on the batch.
    alone = evaluate(ExpertAgent, GRASP, SEEDS[:1], batch=1, workers=1, upset=True)
    assert repr(as_table([alone[0].row])) == repr(as_table(rows[:1]))
    counts = summary(rows)["upsets"]
    assert set(counts) == {"push"} and (counts["push"]["k"], counts["push"]["n"]) == (3, 3)
    plain = evaluate(ExpertAgent, GRASP, SEEDS[:1], workers=1)
    assert (plain[0].row.upset, plain[0].row.upset_step, plain[0].row.recovered) == ("", -1, False)
    assert "upsets" not in summary([plain[0].row])


def test_a_start_that_cannot_be_made_has_nothing_of_the_episode_before(monkeypatch):
    slot = Slot(0, ZeroAgent(), TaskConfig(names.SUTURE, max_steps=2), upset=True)
    slot.begin(SEEDS[0])
    while not slot.ended:
        slot.step(np.zeros(7, np.float32))
    slot._mishap = SimpleNamespace(kind="push", step=33)
    slot.take()

    def impossible(**_):
        raise PhysicsError("impossible start")

    monkeypatch.setattr(slot.env, "reset", impossible)
    slot.begin(SEEDS[1])
    episode = slot.take()
    slot.env.close()
    assert episode.row.error == "impossible start" and episode.visits == ()
    assert (episode.row.upset, episode.row.upset_step, episode.row.recovered) == ("", -1, False)
    assert math.isnan(episode.row.false_ends) and math.isnan(episode.row.end_delay_s)


def test_a_disturbed_evaluation_is_another_run_with_another_name():
    run = RunConfig(GRASP, policy="expert")
    upset = dataclasses.replace(run, upset=True)
    assert upset.name == "expert-upset"
    assert condition_of(upset) != condition_of(run)
    assert condition_of(run).plain and not condition_of(upset).plain
    assert "upset" in condition_of(upset).label
    assert of_training(upset) == run


def test_the_expert_that_goes_back_is_a_baseline_of_the_whole_procedure():
    spec = open_policy("recover")
    assert spec.config.task == names.SUTURE and not spec.run.is_trained
    with pytest.raises(InputError, match="give --task suture"):
        open_policy("recover", task="grasp")


def test_the_command_keeps_disturbed_rows_apart(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["evaluate", "zero", "--task", "grasp", "--episodes", "1", "--workers", "1"]
    short = ["--upset", "--json"]
    assert main([*arguments, *short]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["policy"] == "zero-upset" and "zero-upset" in told["out"]
    assert told["upsets"]["push"]["n"] == 1
    refused = ["evaluate", "hierarchical.yaml", "--expert-swap", "all", "--upset"]
    assert main(refused) == 2
    assert "--upset does not go with" in capsys.readouterr().err
