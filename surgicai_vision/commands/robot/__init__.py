"""`robot`: commands that speak CRTK, one module each."""

from types import MappingProxyType

from cyclopts import App

from surgicai_vision.commands import register

COMMANDS = MappingProxyType(
    {
        "serve": "Serve the simulation as a dVRK that speaks CRTK over ROS 2.",
        "drive": "Let a policy drive a dVRK, simulated or real, within guards.",
    }
)
"""Command → what it does, in one line."""

app = App(name="robot")
register(app, COMMANDS, __name__)
