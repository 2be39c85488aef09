"""Errors of the operating system, as a command line tells them: in one line."""

import errno
import os
import sys

from surgicai_vision.core.errors import InputError, SurgicaiError

FULL = (errno.ENOSPC, errno.EDQUOT)
NO_ROOM = "The disk is full; make room, and run the same command again to continue."
OF_FILES = (errno.EFBIG, errno.EIO, errno.ESTALE, errno.EROFS)
"""What a write to an open file may end in; such an error names no file."""


def of_os_error(error: OSError) -> SurgicaiError:
    """Return an error of the operating system as one of ours.

    Raises:
        OSError: the error itself, if it names no file and files do not end in it; it is a defect of
            the program then.
    """
    if error.errno in FULL:
        return SurgicaiError(NO_ROOM)
    if error.filename is None:
        if error.errno in OF_FILES:
            return SurgicaiError(f"A file could not be written or read: {error.strerror}.")
        raise error
    kind = InputError if error.errno == errno.ENAMETOOLONG else SurgicaiError
    return kind(f"{error.filename}: {error.strerror}.")


def drop_output() -> None:
    """Drop what is still to be printed: nobody reads it, and Python would complain at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
