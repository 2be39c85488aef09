"""`policy`: commands on a trained policy, one module each."""

from types import MappingProxyType

from cyclopts import App

from surgicai_vision.commands import register

COMMANDS = MappingProxyType(
    {
        "push": "Share a policy on the Hugging Face Hub, with a model card.",
        "pull": "Fetch a policy from the Hugging Face Hub and verify it.",
        "tune": "Choose how confidently and patiently a hierarchical policy ends subtasks.",
    }
)
"""Command → what it does, in one line."""

app = App(name="policy")
register(app, COMMANDS, __name__)
