"""A display that is a browser page, full-screen, on this computer or another: no GUI toolkit, no colour management.

The page draws each picture pixel by pixel, waits two animation frames, so that the picture is on the screen, and
answers with a checksum of the pixels it has drawn.
"""

import threading
import time

import numpy as np

from mwdn.capture.display import Display
from mwdn.capture.page_hub import MESSAGE_BYTES, Hub
from mwdn.capture.screen import Picture, Screen
from mwdn.errors import DisplayError
from mwdn.runtime.requirement import require
from mwdn.runtime.web_access import LOOPBACK, check_token, listen, page_url

PAGE_PACKAGES = ("starlette", "websockets", "uvicorn")

SHOW_S = 30.0
"""Seconds in which a picture must be shown: a page that was closed meanwhile can be opened again."""


class PageDisplay(Display):
    """Serves the page and shows pictures on it.

    Args:
        width_cm: lit width of the display.
        height_cm: likewise.
        distance_cm: from the camera.
        host: address to listen on; others than `LOOPBACK` need a token.
        port: 0 for a free one.
        token: secret that a page must know, part of `url`.
        show_s: seconds in which a picture must be shown.

    Raises:
        ParameterError: no token where one is needed, or the address cannot be used.
        MissingPackageError: the extra `page` is not installed.
    """

    def __init__(
        self,
        *,
        width_cm: float,
        height_cm: float,
        distance_cm: float,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str = "",
        show_s: float = SHOW_S,
    ) -> None:
        for name in PAGE_PACKAGES:
            require(name, "page", purpose="The display page")
        check_token(host, token)
        self._cm = {"width_cm": width_cm, "height_cm": height_cm, "distance_cm": distance_cm}
        Screen(width_px=1, height_px=1, **self._cm)
        self.show_s = show_s
        self._socket = listen(host, port)
        self.url = page_url(host, self._socket, token)
        self._hub = Hub(token, self._cm, any_host=host not in LOOPBACK)
        self._start()

    def _start(self) -> None:
        import uvicorn

        config = uvicorn.Config(
            self._hub.app(),
            ws="websockets-sansio",
            ws_max_size=MESSAGE_BYTES,
            log_level="error",
            lifespan="on",
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), daemon=True)
        self._thread.start()
        if not self._hub.started.wait(30):
            raise DisplayError("The display page could not be served. Choose another `port`.")

    def wait(self, seconds: float | None = None) -> Screen:
        """Wait until a page is open and a person has pressed start; forever unless ``seconds`` are given.

        Raises:
            DisplayError: none was opened and started in time.
        """
        with self._hub.changed:
            if not self._hub.changed.wait_for(lambda: self._hub.size is not None and self._hub.ready, seconds):
                raise DisplayError(f"No page is open. Open {self.url} on the display, full-screen.")
        return self.screen

    @property
    def screen(self) -> Screen:
        """Pixels of the page, and centimetres."""
        size = self._hub.size
        if size is None:
            raise DisplayError(f"No page is open. Open {self.url} on the display, full-screen.")
        return Screen(width_px=size[1], height_px=size[0], **self._cm)

    def show(self, picture: Picture) -> float:
        """Show a picture; a page that has lost its connection shows it once it is back."""
        deadline = time.monotonic() + self.show_s
        number = self._hub.send(picture)
        with self._hub.changed:
            while True:
                answer = self._hub.answers.get(number)
                if answer is not None:
                    break
                left = deadline - time.monotonic()
                if left <= 0 or not self._hub.changed.wait(left):
                    raise DisplayError(self._why_not(picture))
        if answer.get("error"):
            raise DisplayError(f"The page cannot show the picture: {answer['error']}. Use another browser.")
        shown = int(answer["height"]), int(answer["width"])
        if shown != picture.shape[:2]:
            raise DisplayError(_resized(shown, picture))
        if int(answer["sum"]) != checksum(picture):
            raise DisplayError(
                "The page shows other pixels than it was sent. Switch colour management, night light and the browser's "
                "protection against fingerprinting off, or use another browser."
            )
        return time.time()

    def _why_not(self, picture: Picture) -> str:
        hub = self._hub
        if hub.size is None:
            return f"No page is open any more. Open {self.url} on the display, full-screen; nothing is lost."
        if hub.size != picture.shape[:2]:
            return _resized(hub.size, picture)
        hidden = " It is hidden: bring it to the front." if not hub.visible else ""
        return f"The page has not confirmed a picture for {self.show_s:g} s.{hidden} Reload it; nothing is lost."

    def close(self) -> None:
        """Stop serving."""
        self._server.should_exit = True
        self._hub.disconnect()
        self._thread.join(timeout=10)
        self._socket.close()

    def __enter__(self) -> "PageDisplay":
        return self


def _resized(size: tuple[int, int], picture: Picture) -> str:
    now, before = (f"{width} x {height}" for height, width in (size, picture.shape[:2]))
    return f"The page has {now} pixels, but had {before}. Make it full-screen, with the same zoom; nothing is lost."


def checksum(picture: Picture) -> int:
    """Sum of (2 i + 1) times pixel i, which is R + 2^8 G + 2^16 B + 2^24 255, modulo 2^32."""
    rgba = np.full((*picture.shape[:2], 4), 255, np.uint8)
    rgba[..., :3] = picture
    numbers = rgba.reshape(-1, 4).view("<u4")[:, 0].astype(np.uint64)
    weights = 2 * np.arange(len(numbers), dtype=np.uint64) + 1
    return int((numbers * weights % 2**32).sum() % 2**32)
