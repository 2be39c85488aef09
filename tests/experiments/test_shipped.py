"""The policies that come with the package: what their cards say is true."""

import pytest

from surgicai_vision.core import names
from surgicai_vision.core.files import PACKAGE, sha256_file
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.experiments.plan_config import read_plan
from surgicai_vision.training import released

PLAN = read_plan()
COUNTED = (*(policy.name for policy in PLAN.policies if policy.acts), names.SUTURE)
SUTURES_SEWN = 2
"""Whole procedures to sew here: one takes as long as five subtasks."""


def test_what_is_shipped_is_what_the_plan_builds():
    shipped = {path.parent.name for path in (PACKAGE / "released").glob(f"*/{released.CARD}")}
    assert shipped == set(PLAN.names)


@pytest.mark.parametrize("name", PLAN.names)
def test_a_shipped_policy_is_what_its_card_says(name):
    card = released.read_card(name)
    folder = PACKAGE / "released" / name
    assert card.name == name and card.licence == PLAN.licence and card.data and card.code_version
    assert card.files == {
        path.name: sha256_file(path) for path in folder.iterdir() if path.name != released.CARD
    }
    assert sum(path.stat().st_size for path in folder.iterdir()) < 4e6
    assert not released.mismatch(card), "of the present scene: else rebuild it by `make released`"
    assert (card.successes is not None) == (name in COUNTED)
    if card.successes is not None:
        assert card.starts.episodes == PLAN.episodes and card.successes >= len(card.solved)


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTED)
def test_a_shipped_policy_solves_the_starts_that_its_card_names(name):
    card = released.read_card(name)
    assert len(card.solved) == 5
    starts = card.solved[:SUTURES_SEWN] if name == names.SUTURE else card.solved
    spec = open_policy(f"{released.PREFIX}{name}")
    episodes = evaluate(spec.make_agent, spec.config, starts, workers=1)
    assert [episode.row.success for episode in episodes] == [True] * len(starts)
