"""The [data] of a benchmark's recipe: what each data set is made of, and the paper's own as presets."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mwdn.calibration import Calibration
from mwdn.data.mismatch import EXACT, Mismatch
from mwdn.data.recorded import Division
from mwdn.data.simulated import Placement
from mwdn.evaluation import Protocol
from mwdn.optics import Deviation, Sensor


@dataclass(frozen=True)
class DatasetRecipe:
    """Pairs of one camera: simulated from photographs, or recorded.

    Args:
        camera: camera file of `mwdn calibrate`, for the settings of the camera that are not given here.
        psf: of the calibration, a file.
        bin: side of the blocks of pixels of PSF and captures that are averaged; the protocol shrinks with them.
        psf_bin: factor on ``bin`` for the PSF, whose pixels may be finer than those of the captures; 0 for the bin of
            the camera file.
        background: even light under the PSF, as a part of the full scale; estimated if negative.
        upside_down: files have their first row at the bottom.
        bgr: files have their channels in the order blue, green, red.
        photos: folder to simulate training from; every 20th photograph is for validation.
        test_photos: folder to simulate the test from.
        train: pairs to train on that are made once; 0 makes every sample a new one.
        validation: pairs to choose the best weights by.
        test: number of pairs to score on; for recorded pairs an upper limit, 0 for all.
        seed: of all that is simulated.
        placement: how a photograph stands in the scene.
        deviation: of the true camera, which makes the measurements, from the calibration, which the methods get.
        mismatch: the same, drawn anew for each pair, in place of one true camera; see `mwdn.data.mismatch.Mismatch`.
        sensor: its noise; that of the camera file unless given.
        pairs: recorded ones in place of photographs: a file of ``mwdn import``, or a data set of this ``kind``.
        kind: how they are laid out, see `mwdn.data.kinds.KINDS`; empty for a file of pairs.
        split: which are for what, see `mwdn.data.splits.split`; empty if all are for the test.
        trained_on: another data set, of the same camera, whose networks are tested here; nothing is trained.
        captures: real ones without a scene, files and folders, to be shown.
        protocol: the part of each picture that counts, in pixels before ``bin``.
    """

    camera: str = ""
    psf: str = ""
    bin: int = 1
    psf_bin: int = 1
    background: float = -1.0
    upside_down: bool = False
    bgr: bool = False
    photos: str = ""
    test_photos: str = ""
    train: int = 1000
    validation: int = 16
    test: int = 24
    seed: int = 0
    placement: Placement = Placement()
    deviation: Deviation = Deviation()
    mismatch: Mismatch = EXACT
    sensor: Sensor = Sensor()
    pairs: str = ""
    kind: str = ""
    split: str = ""
    trained_on: str = ""
    captures: tuple[str, ...] = ()
    protocol: str = "full"

    def division(self) -> Division:
        """How the pairs are divided; the default where there is no ``split`` of recorded ones."""
        if not self.pairs and self.train:
            count = self.train + self.validation + self.test
            return Division("in-order", (self.train / count, self.validation / count, self.test / count))
        return Division(self.split, seed=self.seed) if self.split else Division()

    def binned_protocol(self) -> Protocol:
        """The protocol at the size of the binned pictures: "centre-128" binned by 2 is "centre-64"."""
        whole = Protocol.parse(self.protocol)
        if whole.centre:
            return Protocol.parse(f"centre-{whole.centre // self.bin}")
        if whole.rows and whole.columns:
            (top, bottom), (left, right) = whole.rows, whole.columns
            top, bottom, left, right = (number // self.bin for number in (top, bottom, left, right))
            return Protocol.parse(f"{top}:{bottom},{left}:{right}")
        return whole

    def calibration(self) -> Calibration:
        """Read the PSF."""
        options: dict[str, Any] = {"bin": self.bin, "bgr": self.bgr, "upside_down": self.upside_down}
        options["background"] = self.background if self.background >= 0 else "estimate"
        if self.psf_bin:
            options["psf_bin"] = self.bin * self.psf_bin
        if not self.camera:
            return Calibration.from_file(self.psf, **options)
        # Reconstructions are compared with scenes in the camera's colours.
        return replace(Calibration.load(self.camera, psf=Path(self.psf), **options), white_balance=None)


_PAPER = DatasetRecipe(protocol="centre-128")
_DIFFUSERCAM = DatasetRecipe(background=0.0, upside_down=True, bgr=True, protocol="60:270,60:440")
_PHLATCAM = DatasetRecipe(background=0.0)
_REAL = Deviation(turn_degrees=0.5, haze=0.1, off_axis=1.0)

PRESETS: dict[str, DatasetRecipe] = {
    # The display fills 137 of 320 pixels and lies 2.5 off the centre; 91.5 are free on each side (0.027 of them).
    "mwdn-sim": replace(_PAPER, placement=Placement((0.428, 0.428), 1.0, 0.0, 0.027), deviation=_REAL),
    # Scenes of many sizes about the 210 x 380 that its display filled; the noise explains its captures.
    "diffusercam-sim": replace(
        _DIFFUSERCAM,
        placement=Placement((0.7, 1.5), 1.6, 5.0, 0.8),
        deviation=replace(_REAL, turn_degrees=0.3),
        sensor=Sensor(5000.0, 7.0),
    ),
    # Scenes of 384 x 384 in the middle of 384 x 640: their position is not published.
    "phlatcam-sim": replace(
        _PHLATCAM, placement=Placement((1.0, 1.0), 1.0, 0.0, 0.0), deviation=_REAL, protocol="0:384,128:512"
    ),
    "diffusercam-real": replace(_DIFFUSERCAM, kind="diffusercam", trained_on="diffusercam-sim", test=0),
    # The public sets in their own layouts, and their own splits.
    "mwdn": replace(_PAPER, kind="mwdn", split="paper", test=0),
    "diffusercam": replace(_DIFFUSERCAM, kind="diffusercam", split="diffusercam", validation=2500, test=0),
    "diffusercam-paper": replace(_DIFFUSERCAM, kind="diffusercam", split="paper", validation=2500, test=0),
    "phlatcam": replace(_PHLATCAM, kind="phlatcam", split="phlatcam", test=0),
}
"""Presets of the paper's data sets; a recipe names the files, and may replace any value."""
