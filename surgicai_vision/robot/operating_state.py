"""OperatingState: whether an arm obeys, as in CRTK.

    DISABLED ──enable──► ENABLED ◄──resume── PAUSED ◄──pause── ENABLED
    any ──disable──► DISABLED      any ──fault──► FAULT ──clear_fault──► DISABLED

States and commands are CRTK's; which command is allowed in which state follows
dvrk_simulator_base/operating_state.py. An arm moves only in ENABLED, and only when it is homed.
"""

from surgicai_vision.core.errors import InputError, UnknownName

DISABLED = "DISABLED"
ENABLED = "ENABLED"
PAUSED = "PAUSED"
FAULT = "FAULT"
STATES = (DISABLED, ENABLED, PAUSED, FAULT)

_ANY = frozenset(STATES)
_MOVES: dict[str, tuple[frozenset[str], str]] = {
    "enable": (_ANY - {FAULT}, ENABLED),
    "disable": (_ANY, DISABLED),
    "pause": (frozenset({ENABLED}), PAUSED),
    "resume": (frozenset({PAUSED}), ENABLED),
    "fault": (_ANY, FAULT),
    "clear_fault": (frozenset({FAULT}), DISABLED),
    "reset": (frozenset({FAULT}), DISABLED),
}
"""Command → the states it is allowed in, and the state it leads to."""
_HOMINGS = {"home": True, "unhome": False}
COMMANDS = (*_MOVES, *_HOMINGS)


class OperatingStates:
    """The operating state of one arm; see the module's docstring.

    Args:
        state: the first state.

    Attributes:
        state: one of `STATES`.
        is_homed: whether its joints' zeros are known; a simulation's always are.
    """

    def __init__(self, state: str = ENABLED):
        self.state = state
        self.is_homed = True

    @property
    def may_move(self) -> bool:
        """Return True if motion commands are obeyed."""
        return self.state == ENABLED and self.is_homed

    def command(self, text: str) -> None:
        """Obey a `state_command`, in upper or lower case.

        Raises:
            InputError: no such command, or not allowed in the present state.
        """
        word = text.strip().lower()
        if word in _HOMINGS:
            self.is_homed = _HOMINGS[word]
            return
        if word not in _MOVES:
            raise UnknownName("state_command", text[:40], COMMANDS)
        allowed, following = _MOVES[word]
        if self.state not in allowed:
            raise InputError(
                f"'{word}' is not possible in {self.state}; it is in {', '.join(sorted(allowed))}."
            )
        self.state = following
