"""Read the options of a command, or of a class that a test made, as the command line does."""

from collections.abc import Sequence
from pathlib import Path

from cyclopts import App, CycloptsError

from surgicai_vision.commands.main import explain
from surgicai_vision.commands.options import from_file, split_comma_lists


def read_options[T](cls: type[T], words: Sequence[str] = (), config: Path | None = None) -> T:
    """Return the options that the words of a command line and a `--config` file give."""
    sources = (split_comma_lists, *([from_file(config)] if config else []))
    app = App(config=sources, result_action="return_value", print_error=False, exit_on_error=False)

    @app.default
    def options_of(options: cls = None):
        return options or cls()

    try:
        return app([*words])
    except CycloptsError as error:
        raise explain(error) from None
