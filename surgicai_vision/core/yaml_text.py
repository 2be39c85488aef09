"""YAML as its users write it: plain data, in which `3e-4` is a number.

    load_yaml("learning_rate: 3e-4")    # {"learning_rate": 0.0003}

PyYAML follows YAML 1.1, whose numbers with an exponent need a dot and a sign (`3.0e-4`); in 1.2
they do not. What else it reads is what `yaml.safe_load` does.
"""

import re
from typing import final

import yaml

FLOAT_TAG = "tag:yaml.org,2002:float"
EXPONENT = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$")
"""A number with an exponent, as in YAML 1.2."""


@final
class _Loader(yaml.SafeLoader):
    """Plain data alone, with the numbers of YAML 1.2."""


_Loader.add_implicit_resolver(FLOAT_TAG, EXPONENT, list("-+.0123456789"))


def load_yaml(text: str) -> object:
    """Return what a text holds.

    Raises:
        yaml.YAMLError: it is no YAML, or asks for an object.
        ValueError: a value that does not exist, such as a 30th of February.
        RecursionError: it is nested too deeply.
    """
    return yaml.load(text, Loader=_Loader)
