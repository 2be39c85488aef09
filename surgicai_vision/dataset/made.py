"""How the demonstrations of a dataset were made and rendered.

    made = open_dataset(Path("dataset")).made
    made.demonstrator, made.noise, made.variants

`train` stores this with the policy, so that reports tell apart what learned from different data.
"""

from dataclasses import dataclass

from surgicai_vision.core.config import from_mapping
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset.schema import Table


@dataclass(frozen=True)
class Made:
    """How demonstrations were made; of several folders with different values, the largest.

    Attributes:
        demonstrator: who demonstrated, several joined by "+"; None if the dataset does not say.
        noise: strength of the disturbance of the demonstrator's executed actions.
        post_success_steps: control steps that demonstrations continue after their success.
        late: the most control steps by which a loss was noticed late
            (`demos.disturbance.Disturbance`).
        frame_stride: recorded steps between frames.
        variants: the looks in which each demonstration was rendered; None if as recorded.
    """

    demonstrator: str | None = None
    noise: float = 0.0
    post_success_steps: int = 0
    late: int = 0
    frame_stride: int = 1
    variants: Variants | None = None

    @classmethod
    def of(cls, meta: Table) -> "Made":
        """Read it from the content of `meta/surgicai.json`.

        Raises:
            AttributeError, TypeError, ValueError, InputError: a value of the wrong type, or out of
                its range.
        """
        requests = [asked or {} for asked in meta.get("demos_requests", ())]
        rendered = meta.get("request") or {}
        variants = rendered.get("variants")
        return cls(
            "+".join(map(str, meta.get("demonstrators", ()))) or None,
            max((float(asked.get("noise", 0)) for asked in requests), default=0.0),
            max((int(asked.get("post_success_steps", 0)) for asked in requests), default=0),
            max((int(asked.get("late", 0)) for asked in requests), default=0),
            int(rendered.get("frame_stride", 1)),
            from_mapping(Variants, variants, "request: variants") if variants else None,
        )
