"""YAML as its users write it: plain data, in which `3e-4` is a number.

    load_yaml("learning_rate: 3e-4")    # {"learning_rate": 0.0003}
    dump_yaml({"grasp": "08"})          # a line: grasp: '08'

PyYAML follows YAML 1.1, where numbers with an exponent need a dot and a sign (`3.0e-4`), `010` is
8 and `1:30` is 90. Numbers here are those of YAML 1.2, in which `010` is 10 and `1:30` is text;
underscores between digits (`10_000`) are allowed as before. Otherwise it reads what
`yaml.safe_load` reads, but refuses three things before anything is built from them: a key twice in
one table, of which PyYAML takes the last; an alias that refers to itself; and aliases of aliases
that expand to more than memory holds.
"""

import re
from collections.abc import Mapping
from typing import final

import yaml

INT_TAG = "tag:yaml.org,2002:int"
FLOAT_TAG = "tag:yaml.org,2002:float"
MERGE_TAG = "tag:yaml.org,2002:merge"
DIGITS = "[0-9]+(_[0-9]+)*"
NUMBERS = {
    INT_TAG: rf"[-+]?({DIGITS}|0o[0-7]+|0x[0-9a-fA-F]+)",
    FLOAT_TAG: rf"[-+]?(({DIGITS}(\.({DIGITS})?)?|\.{DIGITS})([eE][-+]?[0-9]+)?|\.(inf|Inf|INF))"
    r"|\.(nan|NaN|NAN)",
}
"""Tag → the texts that are such a number; of a text that is both, the first."""
MOST_REPEATED = 100_000
"""Most values that aliases may add to those written; nobody writes a file with more."""


@final
class _Loader(yaml.SafeLoader):
    """Plain data only, with the numbers of YAML 1.2."""


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    """Return the integer that a text stands for: with a prefix octal or hexadecimal."""
    text = loader.construct_scalar(node)
    return int(text, 0 if "o" in text or "x" in text else 10)


_Loader.yaml_implicit_resolvers = {
    first: [resolver for resolver in resolvers if resolver[0] not in NUMBERS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_constructor(INT_TAG, _integer)


@final
class _Dumper(yaml.SafeDumper):
    """Quotes texts that are numbers in YAML 1.1, as PyYAML does, or in 1.2."""


for _tag, _texts in NUMBERS.items():
    for _side in (_Loader, _Dumper):
        _side.add_implicit_resolver(_tag, re.compile(f"({_texts})$"), list("-+.0123456789"))


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


def dump_yaml(table: Mapping[str, object]) -> str:
    """Return a text from which `load_yaml` returns the same table, keys in their order."""
    text: str = yaml.dump(table, Dumper=_Dumper, sort_keys=False)
    return text


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
