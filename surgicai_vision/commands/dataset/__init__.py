"""`dataset`: commands on an existing dataset, one module each."""

from types import MappingProxyType

from cyclopts import App

from surgicai_vision.commands import register

COMMANDS = MappingProxyType(
    {
        "check": "Read all of a dataset and say what is wrong with it.",
        "convert": "Take some views of a dataset, or store them as video, without rendering.",
        "push": "Share a dataset on the Hugging Face Hub, with a card.",
        "pull": "Fetch a dataset from the Hugging Face Hub and check it.",
    }
)
"""Command → what it does, in one line."""

app = App(name="dataset")
register(app, COMMANDS, __name__)
