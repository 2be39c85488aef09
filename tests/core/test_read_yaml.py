"""YAML files from users: every reader refuses the same files, with one-line errors."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import pytest

from policies.base import Recipe
from policies.chunks import ChunkRecipe
from surgicai_vision.commands.sweep import read_experiment
from surgicai_vision.core.config import JSON, TaskConfig, from_mapping, read_changes
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.files import read_yaml
from surgicai_vision.core.yaml_text import dump_yaml, load_yaml
from surgicai_vision.evaluation.hierarchical_config import read_hierarchical
from surgicai_vision.experiments.plan_config import read_plan
from surgicai_vision.training.policies import load_recipe

WRONG = {
    "list": (b"- 1\n- 2\n", "not a table"),
    "no list": (b"[]", "not a table"),
    "text": (b"true", "not a table"),
    "numbers as keys": (b"1: 2", "not a table"),
    "open": (b"a: [", "not valid YAML"),
    "code": (b"!!python/object/apply:os.system ['true']", "not valid YAML"),
    "bytes": (b"\xff\xfe\x00", "not valid YAML"),
    "no such day": (b"a: 2026-02-31", "refused: ValueError"),
    "deep": (b"a: " + b"[" * 5000, "refused: RecursionError"),
    "key twice": (b"a: 1\nb: {c: 1, 'c': 2}", "not valid YAML.*'c' appears twice"),
    "key twice beside a merge": (b"a: &a {c: 1}\nb: {<<: *a, c: 2, c: 3}", "'c' appears twice"),
    "alias of itself": (b"a: &a [*a]", "a value that it is a part of"),
    "aliases of aliases": (
        b"a: &a0 [1, 1]\n"
        + b"".join(b"b%d: &a%d [*a%d, *a%d]\n" % (n + 1, n + 1, n, n) for n in range(60)),
        "aliases stand for more than",
    ),
}
BIG = "9" * 400
READERS: dict[str, Callable[[Path], object]] = {
    "table": read_yaml,
    "recipe": lambda path: load_recipe("bc", path),
    "hierarchical": read_hierarchical,
    "plan": read_plan,
    "experiment": read_experiment,
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_every_reader_refuses_what_is_no_table(read, tmp_path):
    path = tmp_path / "given.yaml"
    for content, told in WRONG.values():
        path.write_bytes(content)
        with pytest.raises(BadFile, match=told) as caught:
            read(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    for missing in (tmp_path / "missing.yaml", tmp_path):
        with pytest.raises(BadFile, match=f"Cannot read {missing}"):
            read_yaml(missing)


def test_aliases_and_merges_keep_their_meaning(tmp_path):
    path = tmp_path / "given.yaml"
    path.write_text("a: &a {b: 1, c: 2}\nd: {<<: *a, c: 3}\ne: {c: 4, <<: [*a, *a]}\nf: [*a, *a]")
    table = {"b": 1, "c": 2}
    merged = {"d": {**table, "c": 3}, "e": {**table, "c": 4}}
    assert read_yaml(path) == {"a": table, **merged, "f": [table, table]}


@dataclass(frozen=True)
class Theirs:
    """Types that a recipe or an engine of another distribution may have."""

    kind: Literal["soft", "hard"] = "soft"
    width: int | str | None = "auto"
    widths: list[int] = field(default_factory=list)
    pair: tuple[int, str] = (1, "a")
    table: dict[str, JSON] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("kind: loud", "'loud' is unknown; allowed: 'soft', 'hard'"),
        ("width: 1.5", "expected str, got 1.5"),
        ("widths: 7", "expected a list, got 7"),
        ("widths: [1, a]", "expected int, got 'a'"),
        ("pair: [a, 1]", "expected int, got 'a'"),
        ("pair: [1]", "expected 2 values, got 1"),
        ("table: {a: 1, 2: b}", "the key 2 is not text"),
    ],
)
def test_a_value_of_another_type_is_refused(text: str, told: str) -> None:
    with pytest.raises(InputError, match=f"^theirs: .*{told}"):
        from_mapping(Theirs, cast(dict[str, object], load_yaml(text)), "theirs")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("kind: hard", "hard"),
        ("width: 3", 3),
        ("width: wide", "wide"),
        ("width: ~", None),
        ("widths: [1, 2]", [1, 2]),
        ("pair: [2, b]", (2, "b")),
    ],
)
def test_each_type_takes_its_values(text: str, value: object) -> None:
    given = from_mapping(Theirs, cast(dict[str, object], load_yaml(text)))
    assert getattr(given, text.partition(":")[0]) == value


def test_a_setting_with_keys_of_two_types_is_refused() -> None:
    settings = cast(dict[str, JSON], load_yaml("a: {1: 2, b: 3}"))
    with pytest.raises(InputError, match="settings: a is"):
        ChunkRecipe(settings=settings)


@pytest.mark.parametrize(
    ("cls", "table"),
    [
        (TaskConfig, "randomisation: {light: %s}"),
        (TaskConfig, "scene: {thread: %s}"),
        (TaskConfig, "task: %s"),
        (Recipe, "learning_rate: %s"),
        (Recipe, "hidden: [%s]"),
    ],
)
def test_a_number_that_no_float_holds_is_refused(cls, table, tmp_path):
    path = tmp_path / "given.yaml"
    for number in (BIG, f"-{BIG}", f"0x{'f' * 9000}"):
        path.write_text(table % number)
        with pytest.raises(InputError, match="is too large") as caught:
            from_mapping(cls, read_yaml(path), str(path))
        assert len(str(caught.value)) < len(str(path)) + 200


@pytest.mark.parametrize("value", [[["x"] * 9] * 9, {"a": {"b": list(range(99))}}, "x" * 999])
def test_a_message_shows_the_beginning_of_a_value(value):
    for cls, key in ((TaskConfig, "max_steps"), (Recipe, "learning_rate"), (Recipe, "hidden")):
        table = {key: value if key != "hidden" or isinstance(value, str) else [value]}
        with pytest.raises(InputError, match="expected") as caught:
            from_mapping(cls, table)
        assert len(str(caught.value)) < 250


def test_an_empty_file_is_a_table_only_where_it_may_be(tmp_path):
    path = tmp_path / "given.yaml"
    path.write_text("# nothing yet\n")
    assert read_yaml(path, may_be_empty=True) == {}
    assert load_recipe("bc", path) == load_recipe("bc", path, {})
    for read in (read_yaml, read_hierarchical, read_plan):
        with pytest.raises(BadFile, match="not a table"):
            read(path)


def test_a_change_that_no_value_stands_for_is_refused():
    for value in ("[", "2026-02-31", "[" * 5000):
        with pytest.raises(InputError, match="not a YAML value"):
            read_changes((f"a={value}",))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("-1E5", -1e5),
        ("2.5e3", 2500.0),
        (".5e1", 5.0),
        ("3e", "3e"),
        ("e4", "e4"),
        ("'3e-4'", "3e-4"),
        ("12", 12),
        ("010", 10),
        ("-08", -8),
        ("0", 0),
        ("0o17", 15),
        ("0x1F", 31),
        ("10_000", 10_000),
        ("1_0.5", 10.5),
        ("1.", 1.0),
        ("007.5", 7.5),
        ("-.inf", float("-inf")),
        ("1:30", "1:30"),
        ("1:30.5", "1:30.5"),
        ("1_", "1_"),
        ("1.2.3", "1.2.3"),
    ],
)
def test_numbers_are_those_of_yaml_1_2(tmp_path, text, value):
    (tmp_path / "given.yaml").write_text(f"a: {text}\n")
    for found in (read_yaml(tmp_path / "given.yaml")["a"], read_changes((f"a={text}",))["a"]):
        assert found == value and type(found) is type(value)


@pytest.mark.parametrize("text", ["08", "1e5", "3e-4", "0o17", "1:30", "1_000", ".5", "yes", "a"])
def test_a_text_that_is_written_is_read_as_that_text(text):
    table = {"text": text, "numbers": [8, 10, 0.0003, 1e22, True, None]}
    assert load_yaml(dump_yaml(table)) == table
