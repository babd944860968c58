"""One viewer of the live picture: its WebSocket."""

import asyncio
import json
import time
from contextlib import suppress
from typing import Any

from mwdn.errors import MwdnError
from mwdn.preview.live import Live
from mwdn.preview.live_settings import check_message

IN_FLIGHT = 2
"""Frames on their way to a viewer that says which it has shown: what waits on a slow line is old when it arrives."""


class Viewer:
    """Sends the newest frame whenever the viewer is ready for it.

    Args:
        live: the live picture.
        socket: an accepted WebSocket.
    """

    def __init__(self, live: Live, socket: Any) -> None:  # noqa: ANN401
        self.live, self.socket = live, socket
        self._fresh = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._sent = 0
        self._shown: int | None = None

    def wake(self) -> None:
        """There is a new frame; called from any thread."""
        with suppress(RuntimeError):  # the server has stopped
            self._loop.call_soon_threadsafe(self._fresh.set)

    async def send(self) -> None:
        """Send frames without end."""
        last: bytes | None = None
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            newest = self.live.newest
            is_free = self._shown is None or self._sent - self._shown < IN_FLIGHT
            if newest is not None and newest is not last and is_free:
                self._sent, last = self._sent + 1, newest
                await self.socket.send_bytes(newest)

    async def receive(self) -> None:
        """Follow the messages of the viewer until it leaves.

        Raises:
            ParameterError: a message that the page never sends.
        """
        while True:
            message = json.loads(await self.socket.receive_text())
            if message == {"shown": True}:
                self._shown = min((self._shown or 0) + 1, self._sent)
                self._fresh.set()
            elif isinstance(message, dict) and list(message) == ["clock"] and isinstance(message["clock"], int | float):
                await self.socket.send_text(json.dumps({"clock": message["clock"], "server": time.time()}))
            else:
                self.live.control(check_message(message))


async def serve_viewer(live: Live, socket: Any) -> None:  # noqa: ANN401
    """Serve one viewer: a slow one skips frames, and does not delay the others.

    It may send ``{"shown": true}`` after each frame, ``{"clock": number}`` to compare clocks, and the settings of
    `mwdn.preview.live_settings.SETTING_TYPES`.
    """
    from starlette.websockets import WebSocketDisconnect

    await socket.accept()
    viewer = Viewer(live, socket)
    number = live.join(viewer.wake)
    sender = asyncio.create_task(viewer.send())
    try:
        await viewer.receive()
    except (WebSocketDisconnect, RuntimeError):
        pass
    except (MwdnError, ValueError, KeyError, RecursionError, OverflowError):  # not from our page
        await socket.close(1003)
    finally:
        live.leave(number)
        sender.cancel()
