"""A terminal for what behaves otherwise on one."""

import os
import select
import termios


def open_terminal() -> tuple[int, int]:
    """File descriptors of a terminal's two ends: the one to look at and the one to write to."""
    ours, theirs = os.openpty()
    termios.tcsetwinsize(theirs, (24, 120))
    return ours, theirs


def look(terminal: int, patience_s: float) -> str:
    """Return the next output; nothing if nobody writes there any more, or not in time."""
    if not select.select([terminal], [], [], patience_s)[0]:
        return ""
    try:
        return os.read(terminal, 2**16).decode(errors="replace")
    except OSError:
        return ""
