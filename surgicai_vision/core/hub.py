"""Client of the Hugging Face Hub, with every refusal in one line."""

import os
import socket
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from surgicai_vision.core.errors import InputError, SurgicaiError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

CONNECT_SECONDS = 3.0
"""How long the Hub may take to answer before it counts as unreachable."""


def connect(repo: str, api: "HfApi | None" = None) -> "HfApi":
    """Return the Hub's client after checking the repository's name and the network.

    Args:
        repo: "user/name".
        api: a client to use as it is; created here by default.

    Raises:
        InputError: a bad name.
        SurgicaiError: offline, or the Hub does not answer.
    """
    from huggingface_hub import HfApi, constants

    check_repository(repo)
    if api is not None:
        return api
    if constants.HF_HUB_OFFLINE or os.environ.get("HF_HUB_OFFLINE", "").upper() in (
        "1",
        "TRUE",
        "YES",
        "ON",
    ):
        raise SurgicaiError(
            "HF_HUB_OFFLINE is set: nothing is pushed or pulled; unset it to use the Hub."
        )
    reach(constants.ENDPOINT)
    return HfApi()


def check_repository(repo: str) -> None:
    """Raise `InputError` unless `repo` is "user/name", as the Hub allows it."""
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    try:
        validate_repo_id(repo)
    except HFValidationError:
        raise InputError(f"'{repo}' is not a valid name on the Hub; write user/name.") from None
    if repo.count("/") != 1:
        raise InputError(f"'{repo}' does not name its owner; write user/name.")


def reach(endpoint: str) -> None:
    """Raise `SurgicaiError` at once if the Hub, or the proxy in front of it, does not answer."""
    wanted = urllib.parse.urlsplit(endpoint)
    proxy = urllib.request.getproxies().get(wanted.scheme)
    target = urllib.parse.urlsplit(proxy) if proxy else wanted
    port = target.port or (443 if target.scheme == "https" else 80)
    try:
        socket.create_connection((target.hostname or "", port), timeout=CONNECT_SECONDS).close()
    except OSError as error:
        raise SurgicaiError(
            f"The Hub at {wanted.hostname} cannot be reached ({error.strerror or error}); "
            "nothing is pushed or pulled."
        ) from None


@contextmanager
def refusals_in_one_line(repo: str) -> Iterator[None]:
    """Raise refusals of the Hub as a `SurgicaiError` of one line."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError

    try:
        yield
    except (HfHubHTTPError, httpx.HTTPError, OSError) as error:
        text = next(
            (line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__
        )
        raise SurgicaiError(f"The Hub refused {repo}: {text[:200]}") from None
