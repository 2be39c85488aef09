"""The paper's numbers: SurgicAI (NeurIPS 2024 Datasets and Benchmarks).

Success rates as printed. Table 2 is image-based imitation, each encoder with the front and with the
back view; it leaves out insert. The text mentions 20 episodes × 5 seeds; the released code runs 3 ×
20 episodes of one trained policy, and every printed rate is a multiple of 1/60, so intervals are
drawn for n = 60. The released evaluation adds noise to the actions, a different amount for each
encoder.
"""

from surgicai_vision.core import names

SOURCE = "SurgicAI, NeurIPS 2024 Datasets and Benchmarks, Table 2"
EPISODES = 60
"""Episodes behind a printed rate: inferred from the released code and from the printed digits."""

ENCODERS = ("r3m", "clip", "imagenet", "random")
VIEWS = ("front", "back")

_TABLE_2 = {
    "grasp": ((0.22, 0.35), (0.22, 0.32), (0.08, 0.10), (0.03, 0.03)),
    "place": ((0.40, 0.22), (0.30, 0.28), (0.27, 0.20), (0.08, 0.02)),
    "handoff": ((0.80, 0.98), (0.62, 0.78), (0.77, 0.83), (0.03, 0.07)),
    "pullout": ((0.82, 0.63), (0.62, 0.60), (0.35, 0.20), (0.10, 0.08)),
}

STATE_BC = {"grasp": 0.96, "place": 1.00, "insert": 0.97, "handoff": 0.83, "pullout": 0.92}
"""Table 1: behaviour cloning from the state, the ceiling."""

LEARNED_SOURCE = "SurgicAI, NeurIPS 2024 Datasets and Benchmarks, Table 1"
LEARNED = {
    "bc": STATE_BC,
    "td3-her-bc": {"grasp": 0.96, "place": 0.97, "handoff": 0.98},
}
"""Table 1: algorithm → subtask → success after 150,000 steps, with a welded needle and thresholds
on the pose alone. Only the rows in the project's notes on the paper are filled in.
"""

HIERARCHICAL = (0.88, 0.72, 0.60, 0.52)
"""Table 3: the hierarchical policy on sequences that begin with approach (grasp), from the shortest
to the whole.
"""


def rate(task: str, encoder: str, view: str) -> float | None:
    """Return the paper's success rate, or None where it reports none (insert)."""
    if task not in _TABLE_2:
        return None
    return _TABLE_2[task][ENCODERS.index(encoder)][VIEWS.index(view)]


def has(task: str, encoder: str) -> bool:
    """Return True if Table 2 could hold the combination: one of its encoders and a subtask."""
    return task in names.SUBTASKS and encoder in ENCODERS
