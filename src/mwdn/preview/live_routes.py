"""Routes of the live picture: the WebSocket of its viewers, and snapshots."""

from functools import partial
from typing import Any

from anyio import to_thread
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from mwdn.io.images import encode_png
from mwdn.preview.cameras import LIVE_CAMERA, StoredCameras
from mwdn.preview.jobs import Jobs
from mwdn.preview.limits import Limits, RefusedError
from mwdn.preview.live import Live
from mwdn.preview.live_viewer import serve_viewer


class LiveRoutes:
    """The live camera's part of the application.

    Args:
        live: the live picture, or ``None`` if the server has none.
        cameras: gets the live camera's calibration.
        jobs: keeps snapshots.
        limits: of the server.
    """

    def __init__(self, live: Live | None, cameras: StoredCameras, jobs: Jobs, limits: Limits) -> None:
        self.live, self.cameras, self.jobs, self.limits = live, cameras, jobs, limits

    @property
    def routes(self) -> list[Any]:
        """For the application."""
        return [
            WebSocketRoute("/live", self.watch),
            Route("/live/snapshots", self.snapshot, methods=["POST"]),
            Route("/jobs/{id}/capture", self.raw_frame),
        ]

    async def watch(self, socket: WebSocket) -> None:
        """The live picture."""
        if self.live is None or self.live.viewers >= self.limits.viewers:
            await socket.close(1013)  # before it is accepted: status 403
            return
        await serve_viewer(self.live, socket)

    async def snapshot(self, _: Request) -> Response:
        """Keep the newest frame and its picture, as a job that is done."""
        if self.live is None:
            raise RefusedError(409, "This server has no live camera. Start it with one: `mwdn preview --live rig`.")
        picture = self.live.snapshot()
        self.cameras.give(LIVE_CAMERA, picture.calibration)  # for this camera's captures: it knows their bit depth
        job = self.jobs.keep(picture.result())
        return JSONResponse({**job.content(), "camera": LIVE_CAMERA}, 201, {"Location": f"/jobs/{job.id}"})

    async def raw_frame(self, request: Request) -> Response:
        """The raw frame of a snapshot, as a PNG with the sensor's numbers."""
        frame = self.jobs.result(request.path_params["id"]).frame
        if frame is None:
            raise RefusedError(404, "This job is no snapshot of the live camera: its client has the capture.")
        return Response(await to_thread.run_sync(partial(encode_png, frame, "capture.png")), media_type="image/png")
