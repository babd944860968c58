"""`mwdn align`: find displayed pictures in reconstructions, and write aligned pairs."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.progress import track
from mwdn.cli.terminal import Json, counted, if_interrupted, print_json, say, warn
from mwdn.data.captures import read_capture
from mwdn.data.pair_writer import SUFFIXES, check_path
from mwdn.errors import ParameterError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder, refuse_overwrite
from mwdn.io.images import read_frame, write_picture
from mwdn.registration.captured import CapturedPairs, as_gamma, as_light
from mwdn.registration.estimate import Estimate, estimate, through_corners
from mwdn.registration.outline import find_outline
from mwdn.registration.overlay import draw_outline, overlay
from mwdn.registration.pairs import chosen, fit_levels, reconstruct_views, write_aligned
from mwdn.registration.projection import Points, Projection
from mwdn.registration.registration import Place, read_projection, write_registration
from mwdn.registration.views import Views
from mwdn.registration.warp import warp_pictures


@no_empty_folder
def align(  # noqa: PLR0913
    capture: Path,
    picture: Path | None = None,
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"])] = None,
    method: str = "universal",
    count: int = 20,
    points: str | None = None,
    homography: Path | None = None,
    display_gamma: str | None = None,
    levels: bool = True,
    device: str | None = None,
    json: Json = False,
    **options: MethodOptions,
) -> None:
    """Find where displayed pictures are in the camera's frame, and write aligned pairs of a session.

    A picture is found at any place, size, turn and mirroring. Without PICTURE, the outline of the bright display is
    found instead. Beside the result a .json holds the homography, and a .png shows how well it fits.

    Args:
        capture: pairs of `mwdn capture` (.h5), or one raw frame.
        picture: what the display showed in that frame.
        camera: calibration of the camera.
        out: for a session the file of aligned pairs, aligned.h5 unless given; for one frame a folder, results/align.
        method: reconstructs the captures: universal, admm, or any other of `mwdn methods`.
        count: captures of a session that are reconstructed.
        points: start from the corners of the picture as seen in the reconstruction, from its own top left clockwise:
            x,y,x,y,x,y,x,y in pixels.
        homography: take the homography from this .json or file of aligned pairs instead of estimating it.
        display_gamma: light of the display is the pictures' numbers to this power; srgb unless the session says it.
        levels: scale scenes and measurements of a session so that the PSF leads from one to the other.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        json: print the content of the .json to standard output, all else to standard error.
        **options: options of the method.
    """
    if count < 1:
        raise ParameterError(f"`count` ({count}) must be at least 1.")
    corners = None if points is None else _corners(points)
    own = read_options([method], options, align)[method]
    calibration = camera.load()
    reconstruct = partial(Reconstructor, method, device=device, **own)
    gamma = None if display_gamma is None else as_gamma(display_gamma)
    if capture.suffix.lower() in SUFFIXES:
        if picture is not None:
            raise ParameterError(f"`{capture}` has its own pictures. Leave `{picture}` out.")
        pairs = CapturedPairs(capture, calibration, display_gamma=gamma)
        content = _align_session(pairs, reconstruct, out or Path("aligned.h5"), corners, homography, count, levels)
    else:
        out = out or Path("results/align")
        content = _align_frame(capture, picture, calibration, reconstruct, out, corners, homography, gamma, camera)
    if json:
        print_json(content)


def _corners(points: str) -> Points:
    """Four corners from the command line."""
    words = points.replace(" ", ",").split(",")
    try:
        numbers = [float(word) for word in words if word]
    except ValueError:
        numbers = []
    if len(numbers) != 8 or not np.isfinite(numbers).all():
        raise ParameterError(f"`points` ({points}) must be four points: `--points 168,168,305,166,306,303,170,305`.")
    return np.array(numbers).reshape(4, 2)
