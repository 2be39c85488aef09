"""`completion`: print the script that completes commands and options in a shell."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from cyclopts import App, Parameter

from surgicai_vision.commands import main
from surgicai_vision.commands.console import Console

Shell = Literal["bash", "zsh", "fish"]
SHELLS = get_args(Shell)

app = App(
    name="completion",
    help_epilogue="""\
example:
  surgicai-vision completion bash > ~/.local/share/bash-completion/completions/surgicai-vision

zsh and fish:
  surgicai-vision completion zsh > ~/.zfunc/_cyclopts_surgicai-vision  (~/.zfunc in fpath)
  surgicai-vision completion fish > ~/.config/fish/completions/surgicai-vision.fish""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `completion`.

    Attributes:
        shell: The shell to print the script for.
    """

    shell: Annotated[Shell, Parameter(metavar="SHELL")] = field(kw_only=False)


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Print the script."""
    script = main.app.generate_completion(shell=options.shell)
    console.say(script)
    return {"shell": options.shell, "script": script}
