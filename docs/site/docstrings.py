"""Sphinx extension: convert this project's docstrings into the reStructuredText autodoc reads.

They are plain text for a terminal: an indented block is code, a list may follow a line directly, a
star is a literal star, and `name` is code, here linked if the reference documents that name.
"""

import itertools
import re
import sys
from collections.abc import Iterable, Iterator

from sphinx.application import Sphinx

SECTION = re.compile(r"[A-Z][a-z]+:")
"""The heading of a section that napoleon parses, such as `Args:`."""
BULLET = re.compile(r"\s*(\* |- |\d+\. )")
CODE_SPAN = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)
SIGN = re.compile(r"[*|`\\]|(?<=\w)_(?=\W|$)", re.MULTILINE)
"""Characters that reStructuredText would read as markup."""
OURS = ("surgicai_vision.", "encoders.", "policies.")
ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[~?(?:builtins\.)?tuple\[~?(?:typing\.)?(?:Any|int), \.\.\.\], "
    r"~?(?:numpy\.)?dtype\[([^\[\]]+)\]\]"
)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to autodoc, before napoleon."""
    app.connect("autodoc-process-docstring", rewrite_docstring, priority=400)
    app.connect("autodoc-process-signature", shorten_signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def shorten_signature(
    app: Sphinx,
    what: str,
    name: str,
    documented: object,
    options: object,
    arguments: str | None,
    result: str | None,
) -> tuple[str | None, str | None]:
    """Return a signature in which arrays appear as they were written: NDArray[float32]."""
    return tuple(text and ARRAY.sub(r"NDArray[\1]", text) for text in (arguments, result))


def rewrite_docstring(
    app: Sphinx, what: str, name: str, documented: object, options: object, lines: list[str]
) -> None:
    """Rewrite a docstring in place."""
    while name not in sys.modules:  # a class or a function: find its module
        name = name.rpartition(".")[0]
    lines[:] = as_rest(lines, name)
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]  # else napoleon takes the text before a colon for the type


def as_rest(lines: Iterable[str], module: str) -> list[str]:
    """Return a docstring with code blocks marked, lists set apart and markup characters escaped.

    Args:
        lines: the docstring.
        module: the module it is in; names of that module become links.
    """
    result: list[str] = []
    margin = 0  # indent of the surrounding text
    in_code = in_section = False
    for is_text, group in itertools.groupby(lines, key=lambda line: bool(line.strip())):
        paragraph = list(group)
        if not is_text:
            result += paragraph
            continue
        indent = indent_of(paragraph[0])
        starts_section = SECTION.fullmatch(paragraph[0].strip()) is not None
        in_section = starts_section or (in_section and indent > margin)
        was_in_code = in_code
        in_code = not in_section and indent > margin and (in_code or indent >= margin + 4)
        if in_code:
            result += [] if was_in_code else [" " * margin + "::", ""]
            result += paragraph
            continue
        if not in_section or starts_section:
            margin = indent
        result += prose(paragraph, module)
    return result


def indent_of(line: str) -> int:
    """Return the number of spaces at the beginning of a line."""
    return len(line) - len(line.lstrip())


def prose(paragraph: list[str], module: str) -> Iterator[str]:
    """Yield a paragraph's lines: lists after a blank line, code spans linked, markup escaped."""
    text = "\n".join(paragraph)
    parts = CODE_SPAN.split(text)
    for index, part in enumerate(parts):
        if index % 2:
            parts[index] = code_span(" ".join(part.strip("`").split()), module)
        else:  # an invisible space separates a span from a letter right after it
            parts[index] = ("\\ " if index and part[:1].isalnum() else "") + escape(part)
    text = "".join(parts)
    was_list = True
    for line in text.split("\n"):
        is_list = BULLET.match(line) is not None
        if is_list and not was_list:
            yield ""
        was_list = is_list or (was_list and line.startswith(" "))
        yield line


def escape(text: str) -> str:
    """Return text in which only the bullets of lists are markup."""
    lines = []
    for line in text.split("\n"):
        bullet = BULLET.match(line)
        start = bullet.end() if bullet else 0
        lines.append(line[:start] + SIGN.sub(r"\\\g<0>", line[start:]))
    return "\n".join(lines)


def code_span(text: str, module: str) -> str:
    """Return a code span, as a link if it is a full name or a name defined in the module."""
    if text.startswith(OURS) and " " not in text:
        return f":py:obj:`{text}`"
    home = getattr(getattr(sys.modules[module], text, None), "__module__", None)
    if text.isidentifier() and isinstance(home, str) and home.startswith(OURS):
        return f":py:obj:`{text} <{home}.{text}>`"
    return f"``{text}``"
