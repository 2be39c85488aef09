"""Devices: what `--device` names, light to import.

`auto` is a CUDA device where there is one, else the CPU.
"""

from surgicai_vision.core.errors import InputError, check_name

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
        raise InputError("--device cuda: torch finds no CUDA device; take cpu or auto.")
    return CPU
