"""The steps from a raw frame to a scene and the verdicts on it, for batches and for the preview."""

from dataclasses import dataclass
from pathlib import Path

from mwdn.diagnosis.captures import examine_capture, refuse_dark
from mwdn.diagnosis.exif import exif_turn, settle_exif
from mwdn.diagnosis.psf_encoding import PsfGammaTest
from mwdn.diagnosis.sizes import mismatch
from mwdn.diagnosis.trust import Trust, examine_picture
from mwdn.diagnosis.verdict import Verdict
from mwdn.errors import ImageError, ShapeError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.exif import orientation
from mwdn.io.formats import is_for_viewing
from mwdn.runtime.transfers import to_device
from mwdn.solvers import Pose, align
from mwdn.types import Frame, Measurement, Scene


@dataclass(frozen=True)
class PreparedCapture:
    """A capture, ready for the method.

    Args:
        measurement: (1, C, H, W), on the device of the reconstruction, without the light of the room.
        room_light: part of the capture's light that was subtracted as the room's; `None` if it was not looked for.
        pose: of the PSF, if it was estimated.
    """

    measurement: Measurement
    room_light: float | None = None
    pose: Pose | None = None


@dataclass(frozen=True)
class PsfFile:
    """What the file of a PSF tells besides its pixels; by default nothing is known.

    Args:
        is_for_viewing: it is a JPEG or WebP, and so probably gamma-coded.
        orientation: of EXIF, which is compared with the captures'.
    """

    is_for_viewing: bool = False
    orientation: int | None = None

    @classmethod
    def read(cls, file: Path | bytes) -> "PsfFile":
        """From a file, or its content; reads a few hundred bytes, and never fails."""
        return cls(is_for_viewing(file), orientation(file))


class CapturePipeline:
    """From the captures of one camera to scenes and verdicts.

    Each method is one step, so that the caller can report and overlap them. Methods may be called from several threads.

    Args:
        reconstruct: the method and the camera.
        psf_file: of the camera.

    Attributes:
        reconstruct: as given.
        calibration: of the camera.
    """

    def __init__(self, reconstruct: Reconstructor, psf_file: PsfFile = PsfFile()) -> None:
        self.reconstruct, self.calibration = reconstruct, reconstruct.calibration
        self._psf_gamma = PsfGammaTest(self.calibration, psf_file.is_for_viewing)
        self._psf_turn = psf_file.orientation

    def check(self, measurement: Measurement) -> None:
        """Check that a measurement fits the camera.

        Raises:
            ShapeError: it does not fit. It is compared with the PSF at other bins, which takes seconds.
            ImageError: it is dark.
        """
        try:
            self.calibration.check_fit(measurement)
        except ShapeError as error:
            raise mismatch(error, measurement, self.calibration) from None
        refuse_dark(measurement)

    def prepare(self, measurement: Measurement, *, pose: bool) -> PreparedCapture:
        """Subtract the light of the room, if the reconstruction does, and estimate the PSF's pose if requested."""
        measurement, share = self.reconstruct.without_room_light(to_device(measurement, self.reconstruct.device))
        found = align(measurement, self.reconstruct.psf) if pose else None
        return PreparedCapture(measurement, None if share is None else float(share), found)

    def solve(self, prepared: PreparedCapture) -> Scene:
        """The scene, (1, C, H, W) on the device, as the camera sees it: without `Reconstructor.finish`."""
        return self.reconstruct.without_search(prepared.pose).on_device(prepared.measurement)

    def examine_frame(self, frame: Frame, file: Path | bytes) -> tuple[Verdict, ...]:
        """Verdicts on a capture, and on what only the PSF's file and the capture tell about the PSF.

        Args:
            frame: (H, W, C), as `FrameFormat.read` returns it.
            file: of the capture, or its content.
        """
        verdicts = examine_capture(frame, self.calibration, for_viewing=is_for_viewing(file))
        verdicts += self._psf_gamma(frame, verdicts)
        if self._psf_turn is not None and self.calibration.psf_format.psf_orientation is None:
            verdicts += (exif_turn(orientation(file), self._psf_turn),)
        return verdicts

    def examine_scene(
        self, prepared: PreparedCapture, scene: Scene, verdicts: tuple[Verdict, ...]
    ) -> tuple[Trust, tuple[Verdict, ...]]:
        """How far to trust a scene, and all verdicts.

        Args:
            prepared: the capture.
            scene: result of `solve`, which is finite.
            verdicts: of `examine_frame`.

        Raises:
            ImageError: the result is not finite.
        """
        given = self.calibration.psf_format.psf_orientation
        trust = examine_picture(prepared.measurement, self.reconstruct.psf, scene, pose=prepared.pose, given=given)
        if not trust.finite:
            raise _not_finite("check of the picture", prepared)
        return trust, settle_exif((*verdicts, *trust.verdicts))


def refuse_infinite(prepared: PreparedCapture, scene: Scene) -> None:
    """Raise an `ImageError` if a scene holds NaN or infinity."""
    if not scene.isfinite().all():
        raise _not_finite("reconstruction", prepared)


def _not_finite(what: str, prepared: PreparedCapture) -> ImageError:
    return ImageError(
        f"The {what} gave NaN or infinity. The capture's brightest pixel is {prepared.measurement.amax():.3g}, where 1 "
        "is saturation: scale the capture, or use another method."
    )
