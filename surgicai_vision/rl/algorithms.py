"""Algorithms by name: which library has them, what they need and which settings they read.

Light to import, for the command line. What the libraries lack is in small classes of this package:
`nair.DemonstrationTD3` (behaviour cloning with a Q-filter), `buffers.HindsightBuffer` (relabelled
success ends an episode), `rlpd.LayerNormPolicy`, `awac.PlainAWAC` (no entropy in its target).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import final

from surgicai_vision.core.config import JSON

SB3 = "stable_baselines3"
SB3_CONTRIB = "sb3_contrib"
D3RLPY = "d3rlpy"

SUCCESS = ("success_steps", "tolerance_share", "keeps_holes")
"""What a success requires in learning beyond the paper's rule (`core.config.SuccessRule`)."""
COMMON = ("hidden", "learning_rate", "batch_size", "stop_at", *SUCCESS)
VALUED = (*COMMON, "gamma")
ONLINE = (*VALUED, "envs")
OFF_POLICY = (*ONLINE, "tau", "train_every", "updates", "learning_starts", "critics")
DETERMINISTIC = (*OFF_POLICY, "exploration_noise")
TWIN_DELAYED = (*DETERMINISTIC, "policy_delay", "target_noise", "target_noise_clip")
HINDSIGHT = ("goals", "relabel_demand")
CLONING = ("demo_share", "bc_weight", "q_filter", "normalise_q", "clip_q")
OFFLINE_CRITICS = (*VALUED, "tau", "critics")
OFFLINE_SAMPLES = (*OFFLINE_CRITICS, "samples")
CLONED: Mapping[str, JSON] = {"tau": 0.01, "learning_rate": 3e-4}
"""Defaults with a cloning loss: at 1e-3 the policy unlearns again (docs/results/rl.md)."""
PAPERS_RATE = 3e-4
"""Learning rate of AWAC, IQL and Cal-QL in their papers and in d3rlpy, whose Cal-QL uses 1e-4 for
the actor."""


@final
@dataclass(frozen=True)
class Algorithm:
    """One algorithm.

    Attributes:
        library: package that implements it.
        kind: its class there.
        paper: where it is described.
        settings: fields of `Settings` that it reads.
        defaults: settings that differ from those of `Settings`.
        needs_demos: it learns from demonstrations.
        is_online: it takes steps in the env.
        has_layer_norm: its critics have LayerNorm (`rlpd`).
        policy: the registered policy that its actor becomes.
    """

    library: str
    kind: str
    paper: str
    settings: tuple[str, ...]
    defaults: Mapping[str, JSON] = field(default_factory=dict)
    needs_demos: bool = False
    is_online: bool = True
    has_layer_norm: bool = False
    policy: str = "actor"

    @property
    def has_hindsight(self) -> bool:
        """Whether it relabels goals (HER)."""
        return "goals" in self.settings

    @property
    def is_cloning(self) -> bool:
        """Whether a loss of behaviour cloning is added to the actor's."""
        return "bc_weight" in self.settings


def _offline(
    kind: str, paper: str, settings: tuple[str, ...], policy: str = "actor", **defaults: JSON
) -> Algorithm:
    """Return an algorithm of d3rlpy, with settings that differ from those of `Settings`."""
    return Algorithm(
        D3RLPY, kind, paper, settings, defaults, needs_demos=True, is_online=False, policy=policy
    )


HER = "Andrychowicz et al., Hindsight experience replay, NeurIPS 2017, arXiv:1707.01495"
NAIR = (
    "Nair et al., Overcoming exploration in reinforcement learning with demonstrations, ICRA 2018, "
    "arXiv:1709.10089"
)

ALGORITHMS: Mapping[str, Algorithm] = MappingProxyType(
    {
        "ppo": Algorithm(
            SB3,
            "PPO",
            "Schulman et al., Proximal policy optimization algorithms, arXiv:1707.06347",
            (*ONLINE, "rollout"),
        ),
        "ddpg": Algorithm(
            SB3,
            "DDPG",
            "Lillicrap et al., Continuous control with deep reinforcement learning, ICLR 2016, "
            "arXiv:1509.02971",
            DETERMINISTIC,
            {"critics": 1},
        ),
        "sac": Algorithm(
            SB3,
            "SAC",
            "Haarnoja et al., Soft actor-critic, ICML 2018, arXiv:1801.01290",
            OFF_POLICY,
        ),
        "td3": Algorithm(
            SB3,
            "TD3",
            "Fujimoto et al., Addressing function approximation error in actor-critic methods, "
            "ICML 2018, arXiv:1802.09477",
            TWIN_DELAYED,
        ),
        "tqc": Algorithm(
            SB3_CONTRIB,
            "TQC",
            "Kuznetsov et al., Controlling overestimation bias with truncated mixture of "
            "continuous distributional quantile critics, ICML 2020, arXiv:2005.04269",
            OFF_POLICY,
        ),
        "ddpg-her": Algorithm(SB3, "DDPG", HER, (*DETERMINISTIC, *HINDSIGHT), {"critics": 1}),
        "sac-her": Algorithm(SB3, "SAC", HER, (*OFF_POLICY, *HINDSIGHT)),
        "td3-her": Algorithm(SB3, "TD3", HER, (*TWIN_DELAYED, *HINDSIGHT)),
        "td3-bc": Algorithm(SB3, "TD3", NAIR, (*TWIN_DELAYED, *CLONING), CLONED, needs_demos=True),
        "td3-her-bc": Algorithm(
            SB3,
            "TD3",
            NAIR,
            (*TWIN_DELAYED, *HINDSIGHT, *CLONING),
            CLONED,
            needs_demos=True,
        ),
        "td3-her-bc-unfiltered": Algorithm(
            SB3,
            "TD3",
            f"{NAIR}, without its Q-filter: demonstrations are cloned wherever they lead",
            (*TWIN_DELAYED, *HINDSIGHT, *CLONING),
            {**CLONED, "q_filter": False},
            needs_demos=True,
        ),
        "rlpd": Algorithm(
            SB3,
            "SAC",
            "Ball et al., Efficient online reinforcement learning with offline data, ICML 2023, "
            "arXiv:2302.02948",
            (*OFF_POLICY, "demo_share"),
            {"demo_share": 0.5, "hidden": [256, 256]},
            needs_demos=True,
            has_layer_norm=True,
        ),
        "bc": _offline("BC", "Pomerleau, ALVINN, NeurIPS 1988", COMMON),
        "awac": _offline(
            "AWAC",
            "Nair et al., AWAC: accelerating online reinforcement learning with offline datasets, "
            "arXiv:2006.09359",
            OFFLINE_CRITICS,
            learning_rate=PAPERS_RATE,
        ),
        "bcq": _offline(
            "BCQ",
            "Fujimoto et al., Off-policy deep reinforcement learning without exploration, "
            "ICML 2019, arXiv:1812.02900",
            OFFLINE_SAMPLES,
            policy="bcq",
        ),
        "iql": _offline(
            "IQL",
            "Kostrikov et al., Offline reinforcement learning with implicit Q-learning, ICLR 2022, "
            "arXiv:2110.06169",
            OFFLINE_CRITICS,
            learning_rate=PAPERS_RATE,
        ),
        "cal-ql": _offline(
            "CalQL",
            "Nakamoto et al., Cal-QL: calibrated offline RL pre-training for efficient online "
            "fine-tuning, NeurIPS 2023, arXiv:2303.05479",
            OFFLINE_SAMPLES,
            learning_rate=PAPERS_RATE,
        ),
    }
)
"""Name → algorithm, in the order of SurgicAI's tables."""

LEARNED = frozenset({*(algorithm.policy for algorithm in ALGORITHMS.values()), "residual"})
"""Registered policies that an algorithm trains, and imitation does not."""
