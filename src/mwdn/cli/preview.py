"""`mwdn preview`: a page that shows what a lensless camera sees, and the HTTP interface behind it."""

import secrets
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mwdn.calibration import Calibration
from mwdn.capture import open_source
from mwdn.capture.sources import parse_source
from mwdn.cli.camera import CameraOptions
from mwdn.cli.terminal import say
from mwdn.errors import ParameterError
from mwdn.inference.capture_pipeline import PsfFile
from mwdn.preview.cameras import LIVE_CAMERA, StoredCameras
from mwdn.preview.limits import Limits
from mwdn.preview.live import Live
from mwdn.preview.server import log_to_stderr, make_server
from mwdn.runtime.web_access import LOOPBACK

OWN = "camera"
"""Name of the command line's camera on the page."""

LIVE_DEFAULTS: dict[str, dict[str, Any]] = {
    "rig": {"fps": 30.0, "prepared": 8, "pictures": str(files("mwdn.io.pictures"))},
    "replay": {"realtime": True},
}
"""Options of a live camera unless given: the rig runs at a camera's rate and plays the package's photographs; a
recording runs at its own rate."""


def preview(  # noqa: PLR0913
    camera: CameraOptions = CameraOptions(),
    *,
    host: str = "127.0.0.1",
    port: int = 8032,
    token: str = "",
    live: str | None = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/preview"),
    device: str | None = None,
    log: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Serve a page that reconstructs captures, and an HTTP interface: drop a PSF and a capture, or try the samples.

    Args:
        camera: a camera that the page offers beside the samples.
        host: address to listen on. All but 127.0.0.1 can be reached by other computers, and need a token.
        port: to listen on; 0 for a free one.
        token: secret that requests must know; generated if --host is not 127.0.0.1.
        live: a camera to watch, as for `mwdn capture`: rig, v4l2:0, folder:frames, replay:frames.h5,loop=true. Its PSF
            is the camera's, --psf or --camera; the simulated rig has its own.
        out: folder of stored calibrations and recordings.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        log: print each request to standard error, one JSON object a line.
    """
    given: dict[str, Calibration] = {}
    psf_files: dict[str, PsfFile] = {}
    if camera.psf is not None:
        given[OWN] = camera.load()
        psf_files = dict.fromkeys((OWN, LIVE_CAMERA), PsfFile.read(camera.psf_file))
    if out.exists() and not out.is_dir():
        raise ParameterError(f"`{out}` must be a folder, but is a file. Choose another one: `out`.")
    limits = Limits()
    cameras = StoredCameras(limits, out / "cameras", given, psf_files)
    token = token or ("" if host in LOOPBACK else secrets.token_urlsafe(16))
    watched = None if live is None else _open_live(live, given.get(OWN), out / "recordings", device)
    server = make_server(cameras, limits, host=host, port=port, token=token, device=device, live=watched)
    if log:
        log_to_stderr()
    say(f"Open {server.url} (Ctrl-C ends the server)")
    server.run()


def _open_live(text: str, calibration: Calibration | None, folder: Path, device: str | None) -> Live:
    """The live camera; the display of a simulated rig plays the photographs of the package."""
    from mwdn.capture.rig import Rig

    name, _, options = parse_source(text)
    defaults = {key: value for key, value in LIVE_DEFAULTS.get(name, {}).items() if key not in options}
    source = open_source(text, **defaults)
    if isinstance(source, Rig):
        calibration = calibration or Calibration(source.psf)
    if calibration is None:
        raise ParameterError(f"`live` ({text}) needs the PSF of this camera: `--psf psf.png`, `--camera camera.toml`.")
    return Live(source, calibration, folder=folder, device=device)
