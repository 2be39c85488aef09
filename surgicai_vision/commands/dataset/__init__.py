"""`dataset`: verbs on a dataset that exists, one file each."""

from types import MappingProxyType

VERBS = MappingProxyType(
    {
        "check": "read all of a dataset and say what is wrong with it",
        "view": "take some views of a dataset, or store them as video, without rendering",
        "repair": "keep the longest whole prefix of a broken LeRobot dataset",
        "push": "share a dataset on the Hugging Face Hub, with a card",
        "pull": "fetch a dataset from the Hugging Face Hub and check it",
    }
)
"""Verb → what it does, in one line."""
