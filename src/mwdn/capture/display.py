"""Interface of a display: it shows a picture, and confirms it before the capture."""

import time
from abc import ABC, abstractmethod

from mwdn.capture.rig import Rig
from mwdn.capture.screen import Picture, Screen


class Display(ABC):
    """A display in front of a camera. Use it in a ``with`` statement."""

    @property
    @abstractmethod
    def screen(self) -> Screen:
        """Its pixels and centimetres.

        Raises:
            DisplayError: no page is open on it.
        """

    @abstractmethod
    def show(self, picture: Picture) -> float:
        """Show a picture of the display's size; returns when it is shown.

        Args:
            picture: (H, W, 3), RGB, as the display is sent it.

        Returns:
            That moment, by this computer's clock: seconds since 1970.

        Raises:
            DisplayError: it was not shown in time, or otherwise.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the display."""

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RigDisplay(Display):
    """The display of a simulated rig.

    Args:
        rig: whose camera looks at it.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    @property
    def screen(self) -> Screen:
        """Its pixels and centimetres."""
        return self.rig.screen

    def show(self, picture: Picture) -> float:
        """Show a picture at once."""
        self.rig.show(picture)
        return time.time()

    def close(self) -> None:
        """The rig's camera is closed on its own."""
