"""The HTTP interface as an OpenAPI 3.1 document."""

from typing import Any, get_args

from mwdn.io.pictures import PICTURES
from mwdn.preview.cameras import NAME
from mwdn.preview.jobs import State
from mwdn.preview.limits import Limits
from mwdn.preview.result import MEDIA, STOPS, PictureFormat
from mwdn.version import __version__

_ERRORS = {
    "400": "The request is malformed.",
    "401": "The token is missing or wrong.",
    "403": "The request comes from another site's page.",
    "404": "No such thing.",
    "405": "The path has no such method.",
    "408": "The request did not arrive in time.",
    "409": "The name is taken, or the job was cancelled.",
    "413": "Too many bytes or pixels; the message says how many are allowed.",
    "415": "Not a multipart form.",
    "422": "A file, a name or a number is wrong; the message says which, and what to do.",
    "500": "The server cannot write to its disk.",
    "503": "Too many requests wait.",
    "504": "The reconstruction takes too long.",
    "507": "The server's disk is full.",
}
_ERROR = {"application/json": {"schema": {"$ref": "#/components/schemas/Error"}}}
_OBJECT = {"application/json": {"schema": {"type": "object"}}}
_PICTURE = {media: {"schema": {"type": "string", "format": "binary"}} for media, _ in MEDIA.values()}
_FILE = {"type": "string", "format": "binary"}


def openapi(limits: Limits) -> dict[str, Any]:
    """The document.

    Args:
        limits: of the server.
    """
    about = (
        f"Reconstructs captures of lensless cameras. A request has at most {limits.upload_bytes:,} bytes, a frame "
        f"{limits.frame_pixels:,} pixels, a measurement {limits.pixels:,}; a reconstruction ends after "
        f"{limits.seconds:g} s; {limits.at_once} at the same time, {limits.waiting} may wait."
    )
    return {
        "openapi": "3.1.0",
        "info": {"title": "mwdn preview", "version": __version__, "description": about},
        "paths": _paths(),
        "components": {
            "schemas": {"Error": _object(error={"type": "string"}), "Order": _order(), "Job": _job()},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _paths() -> dict[str, Any]:
    order = _form({"$ref": "#/components/schemas/Order"})
    name, id = _path("name", NAME.pattern), _path("id")
    look = [_query("format", {"enum": list(get_args(PictureFormat))}), _query("exposure", _exposure())]
    look.append(_query("white_balance", {"type": "string"}))
    job = {"application/json": {"schema": {"$ref": "#/components/schemas/Job"}}}
    camera_name = {"type": "string", "pattern": f"^{NAME.pattern}$"}
    camera = _object(required=["name", "psf"], psf=_FILE, calibration=_json(), name=camera_name)
    either = _object(psf=_FILE, calibration=_json(), camera={"type": "string"})
    sample = _path("name") | {"schema": {"enum": list(PICTURES)}}
    text = {"text/plain": {"schema": {"type": "string"}}}
    return {
        "/reconstruct": {"post": _operation("Reconstruct a capture and wait for the picture", _PICTURE, body=order)},
        "/jobs": {"post": _operation("Start a reconstruction", job, body=order, status="202")},
        "/jobs/{id}": {
            "get": _operation("State, progress and report", job, [id]),
            "delete": _operation("Cancel it", job, [id]),
        },
        "/jobs/{id}/picture": {"get": _operation("The reconstruction", _PICTURE, [id, *look])},
        "/jobs/{id}/capture": {"get": _operation("The raw frame of a live snapshot, PNG", _PICTURE, [id])},
        "/live/snapshots": {"post": _operation("Keep the newest live frame as a job", job, status="201")},
        "/jobs/{id}/measurement": {"get": _operation("The measurement", _PICTURE, [id, *look])},
        "/cameras": {
            "get": _operation("List calibrations", _OBJECT),
            "post": _operation("Store a calibration", _OBJECT, body=_form(camera), status="201"),
        },
        "/cameras/{name}": {
            "get": _operation("One calibration", _OBJECT, [name]),
            "delete": _operation("Remove a stored calibration", None, [name], status="204"),
        },
        "/cameras/{name}/psf": {"get": _operation("A picture of the PSF", _PICTURE, [name, *look])},
        "/inspect": {"post": _operation("Report the quality of a PSF", _OBJECT, body=_form(either))},
        "/methods": {"get": _operation("Methods, options and limits", _OBJECT)},
        "/samples": {"get": _operation("Captures to try", _OBJECT)},
        "/samples/{name}": {"get": _operation("A capture to try, 16-bit PNG", _PICTURE, [sample])},
        "/healthz": {"get": _operation("Whether requests are served", _OBJECT)},
        "/metrics": {"get": _operation("Metrics for Prometheus", text)},
    }


def _operation(
    summary: str,
    content: dict[str, Any] | None,
    parameters: list[dict[str, Any]] | None = None,
    *,
    body: dict[str, Any] | None = None,
    status: str = "200",
) -> dict[str, Any]:
    done: dict[str, Any] = {"description": summary} | ({"content": content} if content else {})
    responses = {status: done} | {code: {"description": text, "content": _ERROR} for code, text in _ERRORS.items()}
    parts = {"parameters": parameters, "requestBody": body}
    return {"summary": summary, "responses": responses, **{key: part for key, part in parts.items() if part}}


def _order() -> dict[str, Any]:
    return _object(
        required=["capture"],
        capture=_FILE,
        psf=_FILE,
        ambient={**_FILE, "description": "A frame of the room's light alone, taken as the capture."},
        camera={"type": "string", "description": "Name of a calibration, instead of `psf`."},
        calibration=_json('Of `psf`: `{"bin": 4, "gamma": "srgb"}`; names in /methods.'),
        method={"type": "string", "default": "universal-small"},
        options=_json('Of the method: `{"iterations": 50}`.'),
        align={"enum": ["true", "false"], "description": "Fit the pose of the PSF first."},
        room_light={
            "enum": ["true", "false"],
            "description": "Find and subtract the room's light; default: universal.",
        },
        trust={"enum": ["true", "false"], "default": "true", "description": "Check the picture."},
        format={"enum": list(get_args(PictureFormat)), "default": "png"},
        exposure=_exposure(),
        white_balance={
            "type": "string",
            "description": "camera (default), none, grey-world, psf, or gains: 1.8,1,1.5",
        },
    )


def _job() -> dict[str, Any]:
    return _object(
        required=["id", "state", "progress"],
        id={"type": "string"},
        state={"enum": list(get_args(State))},
        progress={"type": "number", "minimum": 0, "maximum": 1},
        error={"type": "string"},
        report={"type": "object"},
    )


def _object(required: list[str] | None = None, **properties: Any) -> dict[str, Any]:  # noqa: ANN401
    return {"type": "object", "properties": properties, **({"required": required} if required else {})}


def _json(about: str = "A JSON object.") -> dict[str, Any]:
    return {"type": "string", "contentMediaType": "application/json", "description": about}


def _exposure() -> dict[str, Any]:
    return {"type": "number", "minimum": -STOPS, "maximum": STOPS, "default": 0, "description": "In stops."}


def _form(schema: dict[str, Any]) -> dict[str, Any]:
    return {"required": True, "content": {"multipart/form-data": {"schema": schema}}}


def _path(name: str, pattern: str = "") -> dict[str, Any]:
    schema = {"type": "string", **({"pattern": f"^{pattern}$"} if pattern else {})}
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _query(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "in": "query", "schema": schema}
