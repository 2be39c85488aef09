"""The verbs, one file each, in the order of the flow.

A verb's module holds `EXAMPLE` (one command line), `Options` (a frozen dataclass: the schema of its
options and of its `--config` file) and `run(options, console) -> dict` (the result `--json`
prints). `NOTES`, where there are any, stand at the end of its `--help`.
A verb that has verbs of its own is a folder with its own `VERBS`.
"""

from types import MappingProxyType

VERBS = MappingProxyType(
    {
        "quickstart": "run the whole flow once, small, and write its report",
        "doctor": "check this machine and say what to do",
        "scene": "show what every camera sees",
        "record-demos": "record demonstrations by the scripted expert",
        "teleoperate": "record demonstrations by keyboard or gamepad",
        "import-demos": "read demonstrations of the original SurgicAI, or bags of ROS 1 and 2",
        "render-demos": "render demonstrations into a LeRobot dataset",
        "dataset": "check, repair, reduce or share a dataset",
        "encode": "compute a dataset's frozen features",
        "probe": "read the needle's pose from frozen features by a linear probe",
        "cache": "list, measure or prune the cached features",
        "train": "train a policy on a dataset's features",
        "evaluate": "run a policy from held-out starts and count successes",
        "robustness": "run a policy while light, cameras, images or the arm shift",
        "sweep": "encode, train and evaluate every cell of a grid",
        "report": "write the report of stored results",
    }
)
"""Verb → what it does, in one line."""


def module_name(verb: str) -> str:
    """Name of the module that holds `verb` ("dataset check" for a verb inside a verb)."""
    return f"{__name__}.{verb.replace('-', '_').replace(' ', '.')}"
