"""YAML as its users write it: plain data, in which `3e-4` is a number.

    load_yaml("learning_rate: 3e-4")    # {"learning_rate": 0.0003}

PyYAML follows YAML 1.1, whose numbers with an exponent need a dot and a sign (`3.0e-4`); in 1.2
they do not. Otherwise it reads what `yaml.safe_load` reads, but refuses three things before
anything is built from them: a key twice in one table, of which PyYAML takes the last; an alias that
refers to itself; and aliases of aliases that expand to more than memory holds.
"""

import re
from typing import final

import yaml

FLOAT_TAG = "tag:yaml.org,2002:float"
MERGE_TAG = "tag:yaml.org,2002:merge"
EXPONENT = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$")
"""A number with an exponent, as in YAML 1.2."""
MOST_REPEATED = 100_000
"""Most values that aliases may add to those written; nobody writes a file with more."""


@final
class _Loader(yaml.SafeLoader):
    """Plain data only, with the numbers of YAML 1.2."""


_Loader.add_implicit_resolver(FLOAT_TAG, EXPONENT, list("-+.0123456789"))


def load_yaml(text: str) -> object:
    """Return the data that a text holds.

    Raises:
        yaml.YAMLError: it is not YAML, requests an object, or has a key twice or too many aliases.
        ValueError: a value that does not exist, such as a 30th of February.
        RecursionError: it is nested too deeply.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        sizes: dict[yaml.Node, int] = {}
        if _size(node, sizes) - len(sizes) > MOST_REPEATED:
            raise _refused(f"its aliases stand for more than {MOST_REPEATED:,} values", node)
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _size(node: yaml.Node, sizes: dict[yaml.Node, int]) -> int:
    """Return how many values a node holds with its aliases expanded, including itself.

    Args:
        node: a value of the text; one with aliases is met several times.
        sizes: sizes of the nodes met before; 0 for those that are being counted.

    Raises:
        yaml.YAMLError: a table holds a key twice, or an alias refers to what it is a part of.
    """
    if node in sizes:
        if sizes[node] == 0:
            raise _refused("an alias stands for a value that it is a part of", node)
        return sizes[node]
    sizes[node] = 0
    size = 1
    if isinstance(node, yaml.MappingNode):
        _check_keys(node)
        for key, value in node.value:
            size += _size(key, sizes) + _size(value, sizes)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            size += _size(item, sizes)
    sizes[node] = size
    return size


def _check_keys(table: yaml.MappingNode) -> None:
    """Refuse a table that holds a key twice; `<<` merges in others, whose keys it may replace."""
    met: set[tuple[str, str]] = set()
    for key, _ in table.value:
        if not isinstance(key, yaml.ScalarNode) or key.tag == MERGE_TAG:
            continue
        if (key.tag, key.value) in met:
            raise _refused(f"the key '{key.value}' appears twice in one table; keep one", key)
        met.add((key.tag, key.value))


def _refused(problem: str, node: yaml.Node) -> yaml.YAMLError:
    """Return the error about a node, with its place in the text."""
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
