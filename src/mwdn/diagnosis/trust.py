"""How far to trust a picture: verdicts on the PSF and on the picture, and the numbers behind them."""

import math
from dataclasses import asdict, dataclass

import torch

from mwdn.calibration.size_advice import MIN_PSF_PX
from mwdn.diagnosis.orientation import OrientationFit, fit_orientations
from mwdn.diagnosis.support_map import Support, support_map
from mwdn.diagnosis.verdict import Verdict
from mwdn.errors import PsfError
from mwdn.evaluation.consistency import Consistency, consistency
from mwdn.optics.orientation import Orientation
from mwdn.solvers.alignment import align
from mwdn.solvers.pose import Pose
from mwdn.types import Measurement, Psf, Scene

MIN_EXPLAINED = 0.25
"""Smallest trusted ``explained / possible``. On real captures the right PSF reaches 0.32 and more."""

MIN_POSSIBLE = 0.03
"""Smallest `Consistency.possible` at which a picture can be judged."""


@dataclass(frozen=True)
class Trust:
    """Consistency of PSF, capture and picture.

    Args:
        consistency: how much of the capture the picture reproduces.
        orientation: how the PSF's mirror images and turns fit the capture.
        support: which parts of the picture the capture supports.
    """

    consistency: Consistency
    orientation: OrientationFit
    support: Support

    @property
    def verdicts(self) -> tuple[Verdict, Verdict]:
        """On the PSF and on the picture."""
        return self.orientation.verdict, self._picture

    @property
    def doubtful(self) -> bool:
        """Whether the PSF or the picture is in doubt."""
        return any(verdict.state == "doubt" for verdict in self.verdicts)

    @property
    def sentence(self) -> str:
        """A one-line summary, which says so if the picture or the PSF cannot be judged."""
        psf, picture = self.verdicts
        text = self.consistency.sentence
        if picture.state == "unknown":  # numbers and pose are then fits to noise
            text = picture.text[0].lower() + picture.text[1:].rstrip(".")
        return f"{text}; this capture cannot judge the PSF" if psf.state == "unknown" else text

    @property
    def content(self) -> dict[str, object]:
        """The numbers, by their names in a sidecar file."""
        return {
            **asdict(self.consistency),
            "contrast": self.orientation.contrast,
            "supported_light": self.support.light,
            "supported_area": self.support.area,
            "doubtful": self.doubtful,
        }

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(math.isfinite(number) for number in self.content.values() if isinstance(number, float))

    @property
    def _picture(self) -> Verdict:
        explained, possible = self.consistency.explained, self.consistency.possible
        if possible < MIN_POSSIBLE:
            text = f"The picture cannot be judged: only {possible:.1%} of the capture's detail is not noise."
            return Verdict("picture", "noise", "unknown", text)
        share = f"{explained / possible:.0%} of what is not noise in the capture's detail"
        if explained < MIN_EXPLAINED * possible:
            return Verdict("picture", "little-explained", "doubt", f"The picture reproduces only {share}.")
        return Verdict("picture", "little-explained", "good", f"The picture reproduces {share}.")


def check_size(psf: Psf) -> None:
    """Raise a `PsfError` if a PSF is too small for a reliable result."""
    height, width = psf.shape[-2:]
    if min(height, width) < MIN_PSF_PX:
        raise PsfError(
            f"The PSF ({height} x {width}) must have at least {MIN_PSF_PX} pixels along each side. Take the whole "
            "frame of the sensor, or crop and bin it less: `crop`, `bin`, `psf_bin`."
        )


@torch.inference_mode()
def examine_picture(
    measurement: Measurement, psf: Psf, scene: Scene, *, pose: Pose | None = None, given: Orientation | None = None
) -> Trust:
    """Judge a PSF and a picture by the capture.

    Args:
        measurement: (1, C, H, W).
        psf: (1, 1 or C, H, W), centred.
        scene: (1, C, H, W), the reconstruction.
        pose: the best pose of the PSF; estimated by `align` unless given.
        given: the ``psf_orientation`` that the PSF already had.

    Raises:
        ShapeError: more than one measurement, or a scene of another shape.
    """
    pose = pose or align(measurement, psf)
    return Trust(
        consistency(measurement, psf, scene, pose=pose),
        fit_orientations(measurement, psf, pose=pose, given=given),
        support_map(measurement, pose.move(psf), scene),
    )
