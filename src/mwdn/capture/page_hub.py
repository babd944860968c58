"""The web application behind a display page: one page at a time, pictures to it and answers from it."""

import asyncio
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np

from mwdn.capture.screen import Picture
from mwdn.errors import ShapeError
from mwdn.runtime.web_access import is_allowed

STATIC = Path(__file__).parent / "static"
PAGE_FILES = {"/": "page.html", "/page.js": "page.js", "/page.css": "page.css"}

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}

MESSAGE_BYTES = 4096
"""Most bytes of a message from a page."""

MAX_PX = 16384
"""Most pixels of a display along each side."""

REPLACED = 4000
"""Code with which a page is closed because another one was opened."""


class Hub:
    """Passes pictures from the session's thread to the page, and the page's answers back."""

    def __init__(self, token: str, cm: dict[str, float], *, any_host: bool) -> None:
        self.token, self.cm, self.any_host = token, cm, any_host
        self.changed, self.started = threading.Condition(), threading.Event()
        self.size: tuple[int, int] | None = None
        self.visible = self.ready = True
        self.answers: dict[int, dict[str, Any]] = {}
        self._number, self._current = 0, b""
        self._page: Any = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def app(self) -> Any:  # noqa: ANN401
        """The web application."""
        from contextlib import asynccontextmanager

        from starlette.applications import Starlette
        from starlette.responses import FileResponse
        from starlette.routing import Route, WebSocketRoute

        @asynccontextmanager
        async def lifespan(_: Starlette) -> Any:  # noqa: ANN401
            self._loop = asyncio.get_running_loop()
            self.started.set()
            yield

        async def file(request: Any) -> FileResponse:  # noqa: ANN401
            return FileResponse(STATIC / PAGE_FILES[request.url.path], headers=HEADERS)

        routes = [Route(path, file) for path in PAGE_FILES]
        return Starlette(routes=[*routes, WebSocketRoute("/display", self._connect)], lifespan=lifespan)

    def send(self, picture: Picture) -> int:
        """Send a picture to the page, now or when there is one; returns its number."""
        import cv2

        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise ShapeError(f"`picture` ({picture.shape}, {picture.dtype}) must be (height, width, 3), uint8.")
        coded = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        with self.changed:
            self._number += 1
            self.answers.clear()
            self._current = self._number.to_bytes(4, "little") + coded.tobytes()
        self._soon(self._send_current)
        return self._number

    def disconnect(self) -> None:
        """Tell the page that the session has ended."""
        self._soon(self._close_page)

    def _soon(self, work: Any) -> None:  # noqa: ANN401
        if self._loop is not None and not self._loop.is_closed():
            asyncio.run_coroutine_threadsafe(work(), self._loop)

    async def _send_current(self) -> None:
        page, current = self._page, self._current
        if page is not None and current:
            await page.send_bytes(current)

    async def _close_page(self) -> None:
        if self._page is not None:
            await self._page.close(1001)

    async def _connect(self, page: Any) -> None:  # noqa: ANN401
        from starlette.websockets import WebSocketDisconnect

        given = page.query_params.get("token", "")
        if not is_allowed(page.headers, given, self.token, any_host=self.any_host):
            await page.close(1008)  # before it is accepted: status 403
            return
        await page.accept()
        before, self._page = self._page, page
        if before is not None:
            await before.close(REPLACED)
        try:
            await page.send_text(json.dumps(self.cm))
            while True:
                await self._take(json.loads(await page.receive_text()))
        except (WebSocketDisconnect, RuntimeError):
            pass
        except (ValueError, KeyError, TypeError, RecursionError):  # not sent by our page
            await page.close(1003)
        finally:
            if self._page is page:
                with self.changed:
                    self._page, self.size = None, None
                    self.changed.notify_all()

    async def _take(self, message: dict[str, Any]) -> None:
        """A message of the page: its size, or an answer to a picture."""
        size = int(message["height"]), int(message["width"])
        if not all(1 <= side <= MAX_PX for side in size):
            raise ValueError("size")
        resend = "id" not in message and self.size is None
        with self.changed:
            self.size, self.visible = size, bool(message.get("visible", True))
            self.ready = bool(message.get("ready", True))
            if "id" in message:
                self.answers[int(message["id"])] = message
            self.changed.notify_all()
        if resend:
            await self._send_current()
