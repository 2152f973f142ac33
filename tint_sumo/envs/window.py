"""A window on the screen that follows an environment, for ``render_mode="human"``.

It is made with tkinter, which comes with Python. Gymnasium's ``HumanRendering`` would need pygame, could not be closed
by hand without ending the episodes, and could not be copied along with an environment.
"""

import os
import time

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError

_INSTEAD = 'use render_mode="rgb_array", or make a film with tint-sumo render'


def has_display() -> bool:
    """Return whether there is a display that a window could be opened on."""
    return bool(os.environ.get("DISPLAY"))


class Window:
    """A window that opens with the first image and shows at most ``fps`` images per second, until it is closed.

    Raises:
        InputError: there is no display, or this Python has no tkinter.
    """

    def __init__(self, title: str, fps: float) -> None:
        try:
            import tkinter  # noqa: PLC0415 - not in every Python
        except ImportError:
            raise InputError(
                f"a window needs tkinter, which this Python lacks (Debian: apt-get install python3-tk); {_INSTEAD}"
            ) from None
        try:
            self._root = tkinter.Tk()
        except tkinter.TclError as error:
            raise InputError(f"there is no display to open a window on ({error}); {_INSTEAD}") from None
        self._root.title(title)
        self._root.resizable(False, False)
        self._root.protocol("WM_DELETE_WINDOW", self.close)
        self._picture = tkinter.PhotoImage(master=self._root)
        tkinter.Label(self._root, image=self._picture, borderwidth=0).pack()
        self._interval_s = 1 / fps
        self._due_s = 0.0
        self._is_open = True

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show an image (H, W, 3) for at least ``1 / fps`` seconds; do nothing if the window is closed."""
        if not self._is_open:
            return
        time.sleep(max(self._due_s - time.monotonic(), 0.0))
        self._due_s = time.monotonic() + self._interval_s
        height, width, _ = image.shape
        self._picture.configure(data=b"P6 %d %d 255\n%b" % (width, height, image.tobytes()), format="PPM")
        self._root.update()

    def close(self) -> None:
        """Close the window; safe to call twice."""
        if self._is_open:
            self._is_open = False
            self._root.destroy()
