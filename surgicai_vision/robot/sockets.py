"""Sockets: keeping a transport to one network interface.

Cyclone DDS and Fast DDS send on the interface they are given, but their receiving sockets are bound
to every address of the machine. Each is therefore bound to the device as well (Linux:
SO_BINDTODEVICE); if that is refused, nothing is opened.
"""

import os
import socket
from pathlib import Path

from surgicai_vision.core.errors import InputError

LAST_DOMAIN = 232
"""Highest domain number whose ports exist (DDSI-RTPS 9.6.1.1)."""


def check_domain(domain: int) -> None:
    """Refuse a number that is not a domain of DDS.

    Raises:
        InputError: below 0 or above 232.
    """
    if not 0 <= domain <= LAST_DOMAIN:
        raise InputError(f"The domain is {domain}; allowed: 0 to {LAST_DOMAIN}.")


def check_interface(interface: str) -> None:
    """Refuse a name that is not a network interface of this machine.

    Raises:
        InputError: there is none of that name.
    """
    names = [name for _, name in socket.if_nameindex()]
    if interface not in names:
        raise InputError(f"There is no interface '{interface}'; available: {', '.join(names)}.")


def open_sockets() -> set[int]:
    """Return the file descriptors of this process that are sockets."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            if os.readlink(entry).startswith("socket:"):
                found.add(int(entry.name))
        except OSError:  # the folder's own descriptor, closed by now
            continue
    return found


def keep_to(descriptors: set[int], interface: str) -> None:
    """Let sockets receive only what comes in on one interface.

    Raises:
        InputError: that is refused; the caller closes what it opened.
    """
    device = interface.encode() + b"\0"
    try:
        for descriptor in descriptors:
            with socket.socket(fileno=os.dup(descriptor)) as one:
                if one.family in (socket.AF_INET, socket.AF_INET6):
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device)
    except OSError as error:
        raise InputError(
            f"The sockets cannot be restricted to {interface} ({error.strerror}); nothing "
            "was opened."
        ) from None
