"""Devices: the values of `--device`, and the random states of devices; light to import.

`auto` is a CUDA device if there is one, else the CPU.

A computation on a GPU draws from two random states of torch, the CPU's and the GPU's:

    states = random_states("cuda")      # both
    …
    set_random_states(states, "cuda")   # the same numbers are drawn again
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from surgicai_vision.core.errors import InputError, check_name

if TYPE_CHECKING:
    import torch

AUTO = "auto"
CPU = "cpu"
CUDA = "cuda"
DEVICES = (AUTO, CPU, CUDA)


def find_device(name: str) -> str:
    """Return "cpu" or "cuda" for one of `DEVICES`.

    Raises:
        UnknownName: another name.
        InputError: there is no CUDA device.
    """
    check_name("device", name, DEVICES)
    if name == CPU:
        return CPU
    import torch  # not at the top: commands that only name a device start without it

    if torch.cuda.is_available():
        return CUDA
    if name == CUDA:
        raise InputError("--device cuda: torch finds no CUDA device; use cpu or auto.")
    return CPU


def cuda_devices(device: str | torch.device) -> list[torch.device]:
    """Return the CUDA devices whose random state a computation uses: none, or the given one."""
    import torch

    device = torch.device(device)
    return [device] if device.type == CUDA else []


def random_states(device: str | torch.device) -> dict[str, torch.Tensor]:
    """Return torch's random states that a computation on a device draws from, by device."""
    import torch

    states = {name: torch.cuda.get_rng_state(name) for name in _names(device) if name != CPU}
    return {CPU: torch.get_rng_state(), **states}


def seeded_random_states(device: str | torch.device, seed: int) -> dict[str, torch.Tensor]:
    """Return what `random_states` returns right after `torch.manual_seed(seed)`."""
    import torch

    return {name: torch.Generator(name).manual_seed(seed).get_state() for name in _names(device)}


def set_random_states(states: Mapping[str, torch.Tensor], device: str | torch.device) -> None:
    """Restore torch's random states to what `random_states` found.

    Args:
        states: from `random_states`; if they are another device's, only the CPU's is restored.
        device: the device that computes.
    """
    import torch

    for name in _names(device):
        if name == CPU:
            torch.set_rng_state(states[name])
        elif name in states:
            torch.cuda.set_rng_state(states[name], name)


def _names(device: str | torch.device) -> list[str]:
    """Return the devices whose random states a computation on a device draws from."""
    return [CPU, *map(str, cuda_devices(device))]
