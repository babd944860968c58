"""`mwdn align`: find displayed pictures in reconstructions, and write aligned pairs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from cyclopts import Parameter
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.progress import track
from mwdn.cli.terminal import Json, all_or_nothing, counted, note, print_json, say, warn
from mwdn.data.captures import read_capture
from mwdn.data.pair_writer import PAIR_SUFFIXES, check_path
from mwdn.errors import ParameterError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.files import check_folder, refuse_overwrite, write_json
from mwdn.io.images import read_frame, write_picture
from mwdn.registration.captured import SRGB, SessionPairs, as_gamma, as_light
from mwdn.registration.correlation import correlation_at
from mwdn.registration.estimate import WORST, estimate, through_corners
from mwdn.registration.outline import find_outline
from mwdn.registration.overlay import draw_outline, overlay
from mwdn.registration.pairs import chosen, fit_levels, reconstruct_views, write_aligned
from mwdn.registration.projection import Points, Projection
from mwdn.registration.registration import Place, read_projection
from mwdn.registration.residuals import Residuals
from mwdn.registration.views import Views
from mwdn.registration.warp import warp_pictures
from mwdn.types import Image, Scene, Size, size_of


@no_empty_folder
def align(  # noqa: PLR0913
    capture: Path,
    picture: Path | None = None,
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/align"),
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
        out: folder for the results, or for a session the file of aligned pairs, ending in .h5.
        method: reconstructs the captures: universal, admm, or any other of `mwdn methods`.
        count: captures of a session that are used to find the homography.
        points: start from the corners of the picture as seen in the reconstruction, from its own top left clockwise:
            x,y,x,y,x,y,x,y in pixels.
        homography: take the homography from this .json or file of aligned pairs instead of estimating it.
        display_gamma: light of the display is PICTURE's numbers to this power, srgb unless given. For a session that
            of its stored pictures, 1 unless given, because `mwdn capture` stores light.
        levels: scale scenes and measurements of a session so that the scene through the PSF is the measurement.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        json: print the content of the .json to standard output, all else to standard error.
        **options: options of the method.
    """
    if count < 1:
        raise ParameterError(f"`count` ({count}) must be at least 1.")
    if points is not None and homography is not None:
        raise ParameterError("`points` are where to start a search, and `homography` replaces it. Give either of them.")
    is_session = capture.suffix.lower() in PAIR_SUFFIXES
    if homography is not None and picture is None and not is_session:
        raise ParameterError("`homography` says where a known picture lies: give PICTURE, too, or leave it out.")
    own = read_options([method], options, align)[method]
    task = _Task(
        calibration=camera.load(),
        reconstruct=partial(Reconstructor, method, device=device, **own),
        corners=None if points is None else _corners(points),
        given=None if homography is None else read_projection(homography),
        gamma=None if display_gamma is None else as_gamma(display_gamma),
        inputs=(capture, *camera.files, *filter(None, (picture, homography))),
    )
    if is_session:
        if picture is not None:
            raise ParameterError(f"`{capture}` has its own pictures. Leave `{picture}` out.")
        out = out if out.suffix.lower() in PAIR_SUFFIXES else out / "aligned.h5"
        content = _align_session(task, capture, out, count, levels=levels)
    else:
        if out.suffix.lower() in PAIR_SUFFIXES:
            raise ParameterError(f"`{out}` must be a folder for one capture; a file of pairs is made from a session.")
        content = _align_frame(task, capture, picture, out)
    if json:
        print_json(content)


@dataclass(frozen=True, eq=False)
class _Task:
    """What both kinds of alignment need.

    Args:
        calibration: of the camera.
        reconstruct: makes a `Reconstructor` for a calibration.
        corners: to start from.
        given: projection that is not to be estimated.
        gamma: of the display.
        inputs: files that must not be overwritten.
    """

    calibration: Calibration
    reconstruct: Callable[[Calibration], Reconstructor]
    corners: Points | None
    given: Projection | None
    gamma: float | str | None
    inputs: tuple[Path, ...]

    def prepare(self, calibration: Calibration) -> Reconstructor:
        """A method for the camera, with its warnings printed."""
        reconstructor = self.reconstruct(replace(calibration, white_balance=None))
        warn(reconstructor.warning)
        return reconstructor

    def register(self, views: Views) -> tuple[Projection, dict[str, Any], Residuals | None]:
        """The given projection, or the estimate from views; its content with its quality, and its residuals."""
        if self.given is None:
            result = estimate(views, corners=self.corners)
            return result.projection, result.content(), result.residuals
        projection = self.given.for_picture(views.picture_size)
        correlation = correlation_at(projection, views, robust=True)
        if correlation < WORST:
            warn(
                f"The first picture fits badly where `homography` puts it: its correlation is {correlation:.2f}, below "
                f"{WORST:g}. Leave it out to align again."
            )
        return projection, {**projection.to_dict(), "correlation": round(correlation, 4)}, None

    def check_given(self, camera: Size, picture: Size) -> None:
        """Check that a given projection leads from pictures of this size to frames of this size."""
        if self.given is not None:
            self.given.check_camera(camera)
            self.given.for_picture(picture)

    def check_outputs(self, *outputs: Path) -> None:
        """Check that files can be written, before any work starts."""
        for output in outputs:
            refuse_overwrite(output, *self.inputs)
        check_folder(outputs[0].parent)


def _align_session(task: _Task, capture: Path, out: Path, count: int, *, levels: bool) -> dict[str, Any]:
    """Align the pairs of a session."""
    check_path(out)
    page, sidecar = out.with_suffix(".png"), out.with_suffix(".json")
    task.check_outputs(out, page, sidecar)
    with (
        SessionPairs(capture, task.calibration, display_gamma=task.gamma or 1.0) as pairs,
        all_or_nothing(out),
    ):
        rows, psf = chosen(len(pairs), count), pairs.calibration.psf
        task.check_given(size_of(psf), pairs.picture_size)
        reconstructor = task.prepare(pairs.calibration)
        first = reconstructor(pairs.measurement(rows[0]))
        if task.given is None:
            views = reconstruct_views(pairs, reconstructor, rows, partial(track, title="Reconstructing"))
        else:
            views = Views.of(list(pairs.picture(rows[0])), list(first))
        projection, content, residuals = task.register(views)
        white = fit_levels(pairs, projection, psf, rows) if levels else None
        write_aligned(out, pairs, projection, content, levels=white, track=partial(track, title="Writing pairs"))
        sheet = overlay(
            first,
            warp_pictures(pairs.picture(rows[0]), projection),
            projection.corners(),
            residuals,
        )
        number = len(pairs)
    write_picture(page, sheet)
    write_json(sidecar, content)
    say(_quality(projection, content), f"{counted(number, 'pair')} written to {out}. Look at {page}")
    return content


def _align_frame(task: _Task, capture: Path, picture: Path | None, out: Path) -> dict[str, Any]:
    """Find one displayed picture, or the outline of the display."""
    page, sidecar = out / f"{capture.stem}.align.png", out / f"{capture.stem}.align.json"
    task.check_outputs(page, sidecar)
    measurement = read_capture(capture, task.calibration)
    shown = None if picture is None else as_light(read_frame(picture, upright=True), task.gamma or SRGB)[None]
    if shown is not None:
        task.check_given(size_of(measurement), size_of(shown))
    reconstructor = task.prepare(task.calibration)
    scene = reconstructor(measurement)
    if shown is None:
        linear = Reconstructor("wiener", reconstructor.calibration, device=reconstructor.device)(measurement)
        projection, content, sheet = _outline(scene, linear, task.corners)
    else:
        projection, content, sheet = _known_picture(task, shown, scene)
    write_picture(page, sheet)
    write_json(sidecar, content)
    say(_quality(projection, content), f"Look at {page}")
    if picture is None and task.corners is None:
        note("It is the brightest region with four straight sides: check that this is the display.")
    return content


class _Placed(NamedTuple):
    """Where the picture is, for the .json and as a picture."""

    projection: Projection
    content: dict[str, Any]
    sheet: Tensor


def _outline(scene: Scene, linear: Scene, corners: Points | None) -> _Placed:
    """The outline of a display whose picture is not known, unless its corners are given."""
    start = "outline" if corners is None else "points"
    if corners is None:
        views = Views.of([*scene, *linear], [*scene, *linear])
        corners = find_outline(np.sqrt(views.reconstructions[0]), views.reconstructions[1])
    place = Place.of(corners)
    shape = max(2, round(place.height)), max(2, round(place.width))
    projection = through_corners(corners, shape, size_of(scene))
    drawn = [draw_outline(image, corners) for image in (scene, linear)]
    sheet = contact_sheet([drawn], ["reconstruction", "Wiener filter"], height=drawn[0].shape[-2])
    return _Placed(projection, {**projection.to_dict(), "start": start}, sheet)


def _known_picture(task: _Task, shown: Image, scene: Scene) -> _Placed:
    """The displayed picture in the reconstruction, unless its homography is given."""
    projection, content, residuals = task.register(Views.of(list(shown), list(scene)))
    sheet = overlay(scene, warp_pictures(shown, projection), projection.corners(), residuals)
    return _Placed(projection, content, sheet)


def _quality(projection: Projection, content: Mapping[str, Any]) -> str:
    """Place of the picture, and how well it fits, in a sentence."""
    radial = f", radial term {projection.radial:.3f}" if projection.radial else ""
    fit, how = "", "found"
    if "residual_px" in content:
        fit = f"; residual {content['residual_px']:.2f} px, correlation {content['correlation']:.3f}{radial}"
    elif "correlation" in content:
        fit, how = f"; correlation {content['correlation']:.3f}{radial}", "placed as given"
    cut = f" {projection.outside:.0%} of it lies outside of the frame." if projection.outside > 0.01 else ""
    return f"Picture {how}: {Place.of(projection.corners())}{fit}.{cut}"


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
