"""The web application: the page, and the HTTP interface that it uses too."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from anyio import CapacityLimiter, to_thread
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from mwdn.calibration import Calibration
from mwdn.errors import MwdnError, ParameterError
from mwdn.inference.capture_pipeline import PsfFile
from mwdn.io.pictures import PICTURES
from mwdn.preview.cameras import CAMERA_OPTIONS, StoredCameras, checked_camera
from mwdn.preview.guard import Guard, failed, log
from mwdn.preview.jobs import ENDED, Job, Jobs
from mwdn.preview.limits import Limits, RefusedError
from mwdn.preview.live import Live
from mwdn.preview.live_routes import LiveRoutes
from mwdn.preview.methods import checked_options, list_methods
from mwdn.preview.metrics import Metrics
from mwdn.preview.openapi import openapi
from mwdn.preview.psf_report import psf_report
from mwdn.preview.reconstruction import Order, Reconstructions
from mwdn.preview.result import MEDIA, Look, encode
from mwdn.preview.routing import route
from mwdn.preview.samples import SAMPLE_CAMERA, sample_png
from mwdn.preview.uploads import LOOKS, Form, look_query, parse_look, read_form
from mwdn.version import __version__

STATIC = Path(__file__).parent / "static"
FORM_FILES = ("capture", "psf", "ambient")
FORM_TEXTS = ("camera", "calibration", "method", "options", "align", "trust", "room_light", *LOOKS)


class Preview:
    """The server's parts, and its routes.

    Args:
        cameras: calibrations by name.
        limits: of the server.
        device: of the reconstructions, see `mwdn.Reconstructor`.
        live: the live camera.
    """

    def __init__(
        self, cameras: StoredCameras, limits: Limits = Limits(), *, device: str | None = None, live: Live | None = None
    ) -> None:
        self.cameras, self.limits, self.metrics = cameras, limits, Metrics()
        self.live = live
        if live is not None:
            live.metrics = self.metrics
        self.jobs, self.reconstructions = Jobs(limits), Reconstructions(limits, device)
        self.metrics.gauges |= {
            "mwdn_jobs_waiting": lambda: self.jobs.waiting,
            "mwdn_jobs_running": lambda: self.jobs.running,
            "mwdn_live_viewers": lambda: live.viewers if live else 0,
        }

    def app(self, *, token: str = "", any_host: bool = False) -> Any:  # noqa: ANN401
        """The application.

        Args:
            token: secret that requests must know; empty if none is needed.
            any_host: it may be called by any name, because it needs a token.
        """

        @asynccontextmanager
        async def lifespan(_: Starlette) -> AsyncIterator[None]:
            self._encoders = CapacityLimiter(2)
            yield
            if self.live is not None:
                await to_thread.run_sync(self.live.close)
            await to_thread.run_sync(self.jobs.close)

        routes = [
            Route("/", self.page),
            Route("/healthz", self.health),
            Route("/metrics", self.prometheus),
            Route("/openapi.json", self.document),
            Route("/methods", self.methods),
            Route("/samples", self.samples),
            Route("/samples/{name}", self.sample),
            route("/cameras", GET=self.list_cameras, POST=self.add_camera),
            route("/cameras/{name}", GET=self.camera, DELETE=self.remove_camera),
            Route("/inspect", self.inspect, methods=["POST"]),
            Route("/cameras/{name}/psf", self.camera_psf),
            Route("/reconstruct", self.reconstruct, methods=["POST"]),
            Route("/jobs", self.add_job, methods=["POST"]),
            route("/jobs/{id}", GET=self.job, DELETE=self.cancel),
            Route("/jobs/{id}/picture", self.picture),
            Route("/jobs/{id}/measurement", self.measurement),
            *LiveRoutes(self.live, self.cameras, self.jobs, self.limits).routes,
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        handlers = {MwdnError: failed, HTTPException: failed, 500: failed}
        app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=handlers)
        return Guard(app, self.limits, self.metrics, token=token, any_host=any_host)

    async def page(self, _: Request) -> Response:
        """The page."""
        return FileResponse(STATIC / "index.html")

    async def health(self, _: Request) -> Response:
        """Whether requests are served."""
        return JSONResponse({"status": "ok", "version": __version__})

    async def prometheus(self, _: Request) -> Response:
        """Metrics."""
        return PlainTextResponse(self.metrics.render(), media_type="text/plain; version=0.0.4")

    async def document(self, _: Request) -> Response:
        """The interface, as OpenAPI 3.1."""
        return JSONResponse(openapi(self.limits))

    async def methods(self, _: Request) -> Response:
        """Methods and their options."""
        live = self.live and self.live.camera.name
        about = {"camera_options": CAMERA_OPTIONS, "limits": vars(self.limits), "live": live}
        return JSONResponse({"methods": list_methods(), **about})

    async def samples(self, _: Request) -> Response:
        """Captures to try."""
        return JSONResponse({"camera": SAMPLE_CAMERA, "captures": PICTURES})

    async def sample(self, request: Request) -> Response:
        """A capture to try, as a 16-bit PNG."""
        name = request.path_params["name"]
        if name not in PICTURES:
            raise RefusedError(404, f"No sample of this name. Known: {', '.join(PICTURES)}.")
        return Response(await self._thread(partial(sample_png, name)), media_type="image/png")

    async def list_cameras(self, _: Request) -> Response:
        """Calibrations by name."""
        return JSONResponse({"cameras": await self._thread(self.cameras.list)})

    async def camera(self, request: Request) -> Response:
        """One calibration."""
        return JSONResponse(await self._thread(partial(self.cameras.described, request.path_params["name"])))

    async def add_camera(self, request: Request) -> Response:
        """Store a calibration."""
        form = await read_form(request, self.limits, ("psf",), ("name", "calibration"))
        name, psf, options = form.texts.get("name", ""), form.file("psf"), form.json("calibration")

        def add(job: Job) -> None:
            self.cameras.add(name, psf, options)

        await self._ended(request, self.jobs.submit(add, size=len(psf)))
        return JSONResponse(await self._thread(partial(self.cameras.described, name)), 201)

    async def remove_camera(self, request: Request) -> Response:
        """Remove a stored calibration."""
        await self._thread(partial(self.cameras.remove, request.path_params["name"]))
        return Response(status_code=204)

    async def inspect(self, request: Request) -> Response:
        """What `mwdn inspect` says about a PSF."""
        form = await read_form(request, self.limits, ("psf",), ("camera", "calibration"))
        read, found = self._calibration(form), {}

        def inspect(job: Job) -> None:
            found.update(psf_report(read()))

        await self._ended(request, self.jobs.submit(inspect, size=len(form.files.get("psf", b""))))
        return JSONResponse(found)

    async def camera_psf(self, request: Request) -> Response:
        """A picture of the PSF."""
        calibration = await self._thread(partial(self.cameras.get, request.path_params["name"]))
        return await self._encoded(lambda look: encode(calibration.psf, look), parse_look(look_query(request)))

    async def reconstruct(self, request: Request) -> Response:
        """Reconstruct a capture: the picture, with the report in a header."""
        form = await read_form(request, self.limits, FORM_FILES, FORM_TEXTS)
        look = parse_look(form.texts)
        job = await self._ended(request, self._submit(form))
        result = self.jobs.result(job.id)
        headers = {"Mwdn-Report": json.dumps(result.report, separators=(",", ":")), "Location": f"/jobs/{job.id}"}
        return await self._encoded(result.encode, look, headers)

    async def add_job(self, request: Request) -> Response:
        """Start a reconstruction, and answer at once."""
        form = await read_form(request, self.limits, FORM_FILES, FORM_TEXTS)
        parse_look(form.texts)  # a mistake is reported now
        job = self._submit(form)
        job.look = {name: form.texts[name] for name in LOOKS if name in form.texts}
        return JSONResponse(job.content(), 202, {"Location": f"/jobs/{job.id}"})

    async def job(self, request: Request) -> Response:
        """State, progress and report of a job."""
        return JSONResponse(self.jobs.get(request.path_params["id"]).content())

    async def cancel(self, request: Request) -> Response:
        """Cancel a job."""
        return JSONResponse(self.jobs.cancel(request.path_params["id"]).content())

    async def picture(self, request: Request) -> Response:
        """The picture of a job; there before it is checked."""
        job = self.jobs.get(request.path_params["id"])
        look = parse_look(job.look | look_query(request))
        return await self._encoded(self.jobs.result(job.id).encode, look)

    async def measurement(self, request: Request) -> Response:
        """The measurement of a job: the capture, corrected, cropped and binned; for viewing without light below 0."""
        measurement, look = self.jobs.result(request.path_params["id"]).measurement, parse_look(look_query(request))
        shown = measurement if look.format in ("tiff", "npy") else measurement.clamp(min=0)
        return await self._encoded(partial(encode, shown), look)

    def _submit(self, form: Form) -> Job:
        """Check a form as far as that is fast, and queue its reconstruction."""
        capture, read, named = form.file("capture"), self._calibration(form), form.texts.get("camera")
        method = form.texts.get("method") or "universal-small"
        order = Order(
            capture=capture,
            calibration=read,
            method=method,
            options=checked_options(method, form.json("options")),
            align=form.flag("align"),
            trust=form.flag("trust") is not False,
            room_light=form.flag("room_light"),
            ambient=form.files.get("ambient", b""),
            psf_file=partial(self.cameras.psf_file, named) if named else partial(PsfFile.read, form.file("psf")),
        )
        job = self.jobs.submit(partial(self.reconstructions.run, order=order), size=sum(map(len, form.files.values())))
        job.when_ended(lambda: self._count(job, method))
        return job

    def _calibration(self, form: Form) -> Callable[[], Calibration]:
        """A function that returns the calibration of a form. It reads an uploaded PSF when the job runs."""
        named, options = form.texts.get("camera", ""), form.json("calibration")
        if ("psf" in form.files) == bool(named):
            raise ParameterError("Give either `psf`, a file, or `camera`, the name of a stored calibration.")
        if named and options:
            raise ParameterError("`calibration` belongs to an uploaded `psf`; a stored `camera` has its own.")
        if named:
            self.cameras.get(named)
            return partial(self.cameras.get, named)
        checked_camera(options)
        return partial(self.cameras.calibrate, form.file("psf"), options)

    def _count(self, job: Job, method: str) -> None:
        seconds = job.result.report["seconds"] if job.result else 0.0
        self.metrics.add("mwdn_reconstructions_total", method=method, outcome=job.state)
        self.metrics.add("mwdn_reconstruction_seconds_sum", seconds, method=method)
        log("reconstruction", method=method, outcome=job.state, seconds=seconds)

    async def _ended(self, request: Request, job: Job) -> Job:
        """Wait for a job; it is cancelled if its client leaves.

        Raises:
            MwdnError: of the job.
        """
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        job.when_ended(partial(_wake, loop, ended))
        while job.state not in ENDED:
            try:
                await asyncio.wait_for(ended.wait(), 0.5)
            except TimeoutError:
                if await request.is_disconnected():
                    self.jobs.cancel(job.id)
                    break
            except asyncio.CancelledError:
                self.jobs.cancel(job.id)
                raise
        if job.error is not None:
            raise job.error
        return job

    async def _encoded(self, make: Callable[[Look], bytes], look: Look, headers: Any = None) -> Response:  # noqa: ANN401
        data = await to_thread.run_sync(make, look, limiter=self._encoders)
        return Response(data, media_type=MEDIA[look.format][0], headers=headers)

    async def _thread(self, work: Callable[[], Any]) -> Any:  # noqa: ANN401
        return await to_thread.run_sync(work, limiter=self._encoders)


def _wake(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    with suppress(RuntimeError):  # the server has stopped
        loop.call_soon_threadsafe(ended.set)
