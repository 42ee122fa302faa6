"""A window that shows pictures, by Tk: part of Python, and needs a display."""

import os
import sys

from simtrack.contracts import Uint8
from simtrack.errors import RenderingError


def has_display() -> bool:
    """Whether there seems to be a display, told without opening a window."""
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


def check_display() -> None:
    """Raise RenderingError where no window can be opened."""
    Window("simtrack").close()


class Window:
    """One window."""

    def __init__(self, title: str) -> None:
        """Open it; raises RenderingError where that cannot be done."""
        try:
            import tkinter

            self._root = tkinter.Tk()
        except Exception as error:  # no Tk in this Python, or no display
            message = f"render_mode 'human' needs a display ({error}); use render_mode 'rgb_array' without one"
            raise RenderingError(message) from error
        self._root.title(title)
        self._label = tkinter.Label(self._root, borderwidth=0)
        self._label.pack()
        self._image = None

    def show(self, picture: Uint8) -> None:
        """Show (H, W, 3)."""
        import tkinter

        if self._root is None:
            raise RenderingError("the window is closed")
        height, width = picture.shape[:2]
        data = b"P6 %d %d 255 " % (width, height) + picture.tobytes()
        self._image = tkinter.PhotoImage(data=data, format="ppm")
        self._label.configure(image=self._image)
        self._root.update()

    def close(self) -> None:
        """Close the window; may be called twice."""
        root, self._root = getattr(self, "_root", None), None
        if root is not None:
            root.destroy()
