"""Words: counts of things in messages and on pages."""


def noun(count: int, word: str) -> str:
    """Return "cell" for one and "cells" for another number."""
    return word if count == 1 else f"{word}s"


def plural(count: int, word: str) -> str:
    """Return "1 cell" or "2 cells"."""
    return f"{count} {noun(count, word)}"
