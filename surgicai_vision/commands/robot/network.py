"""What the commands of `robot` share: how they reach the network."""

import os
from collections.abc import Mapping
from typing import Annotated

from cyclopts import Parameter

from surgicai_vision.commands.options import within
from surgicai_vision.core.errors import InputError
from surgicai_vision.robot.sockets import LAST_DOMAIN
from surgicai_vision.robot.transport import TRANSPORTS

TRANSPORT = Parameter(choices=tuple(TRANSPORTS))
INTERFACE = Parameter(
    help="The only network interface to use; lo reaches this machine only.",
    metavar="NAME",
)
Domain = Annotated[
    int | None,
    Parameter(
        help="ROS domain number, 0 to 232.",
        metavar="N",
        show_default=lambda _: "ROS_DOMAIN_ID, else 0",
    ),
    within(0, LAST_DOMAIN),
]


def ros_domain(given: int | None) -> int:
    """Return the given domain number, else that of ROS's own variable, else 0.

    Raises:
        InputError: the variable holds no domain number.
    """
    if given is not None:
        return given
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        raise InputError(f"ROS_DOMAIN_ID is '{text}'; allowed: 0 to {LAST_DOMAIN}.")
    return int(text)


def renamed_topics(given: Mapping[str, object] | None) -> dict[str, str]:
    """Return the table `topics` of a file: our topic → the robot's name for it."""
    return {name: str(topic) for name, topic in (given or {}).items()}
