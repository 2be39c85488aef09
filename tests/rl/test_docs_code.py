"""docs/rl.md: its Python code runs, in small settings."""

import re
from pathlib import Path

SMALL = {
    "learning_starts=1_000": "learning_starts=2, batch_size=32",
    "buffer_size=100_000": "buffer_size=1_000",
    "learn(50_000)": "learn(5)",
}
"""Text on the page → its replacement for a small run."""


def test_the_code_for_ones_own_library_runs(root: Path, demos: dict[str, Path]) -> None:
    text = (root / "docs/rl.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    for large, small in SMALL.items():
        assert large in code, large
        code = code.replace(large, small)
    code = code.replace("outputs/demos/grasp", str(demos["grasp"]))
    names: dict[str, object] = {}
    exec(compile(code, "docs/rl.md", "exec"), names)
    model = names["model"]
    assert model.num_timesteps == 5 and model._n_updates >= 3  # type: ignore[attr-defined]
