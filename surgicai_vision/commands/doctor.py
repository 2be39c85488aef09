"""`doctor`: check this machine and say what to do."""

import dataclasses

from cyclopts import App

from surgicai_vision.commands.console import Console

app = App(name="doctor", help_epilogue="example:\n  surgicai-vision doctor")


@app.default
def run(*, console: Console) -> dict[str, object]:
    """Print one line per check; the exit code is 1 if something must be repaired."""
    from surgicai_vision.commands.doctor_checks import check

    checks = check()
    width = max(len(line.name) for line in checks)
    for line in checks:
        console.say(f"{line.status:<7}  {line.name:<{width}}  {line.detail}")
        if line.advice:
            console.say(f"{'':<7}  {'':<{width}}  → {line.advice}")
    worst = "fail" if any(line.status == "fail" for line in checks) else "ok"
    return {
        "status": worst,
        "checks": [dataclasses.asdict(line) for line in checks],
        "exit_code": 1 if worst == "fail" else 0,
    }
