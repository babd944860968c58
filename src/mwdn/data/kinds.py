"""The kinds of data sets that can be imported: where their pairs are, and what their numbers mean."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mwdn.calibration import FrameFormat
from mwdn.calibration.frame_format import Gamma, check_gamma
from mwdn.data.scene_place import Place, centre, paper_display
from mwdn.data.sources import Listing, list_folders, list_hdf5, list_pair_file, list_parquet, list_phlatcam
from mwdn.errors import ParameterError
from mwdn.types import Size


@dataclass(frozen=True)
class Layout:
    """Where a data set stores its pairs; ``None`` for the usual place.

    Args:
        captures: folder, data set or column of the measurements.
        scenes: folder, data set or column of the ground truth.
        scene_size: height and width to which scenes are resized, if they are not all of one size.
        scene_place: first row and column of the scenes in the captures' frame, which is dark around them, in pixels of
            the cropped frame before binning; for scenes that show a part of the frame.
        scene_gamma: encoding of the scenes' files, decoded to linear light: "srgb", or a power such as 2.2; without it
            they are taken as linear.

    Raises:
        ParameterError: a size is not positive, a place is negative, or ``scene_gamma`` is not 1 to 4.
    """

    captures: str | None = None
    scenes: str | None = None
    scene_size: Size | None = None
    scene_place: Size | None = None
    scene_gamma: Gamma | None = None

    def __post_init__(self) -> None:
        if self.scene_size is not None and min(self.scene_size) < 1:
            height, width = self.scene_size
            raise ParameterError(f"`scene_size` ({height} x {width}) must be positive: `--scene-size 384 384`.")
        if self.scene_place is not None and min(self.scene_place) < 0:
            top, left = self.scene_place
            raise ParameterError(f"`scene_place` ({top}, {left}) must not be negative: `--scene-place 94 94`.")
        check_gamma("scene_gamma", self.scene_gamma)


@dataclass(frozen=True)
class Kind:
    """A kind of data set.

    Args:
        list_pairs: lists the pairs of a path, given the names of its captures and scenes.
        layout: the usual one.
        frames: the usual format of captures; scenes have the same channel order and orientation.
        raw_frames: the usual format of captures with one channel, if those are raw frames of a colour sensor.
        place: where scenes smaller than the frame are in it. Scenes of such a kind are binned with the captures.
        of_folder: the kind of a folder of pictures, instead of a file.
    """

    list_pairs: Callable[[Path, str, str], Listing]
    layout: Layout
    frames: FrameFormat = FrameFormat()
    raw_frames: FrameFormat | None = None
    place: Place | None = None
    of_folder: "Kind | None" = None


KINDS = {
    # The paper's own data set, written by OpenCV: BGR, channels first. As distributed: folders, scenes of 137 x 137.
    "mwdn": Kind(
        list_hdf5,
        Layout("blur", "gt"),
        FrameFormat(bgr=True),
        place=paper_display,
        of_folder=Kind(list_folders, Layout("blur", "gt"), place=paper_display),
    ),
    "diffusercam": Kind(
        list_folders, Layout("diffuser_images", "ground_truth_lensed"), FrameFormat(bgr=True, upside_down=True)
    ),
    # Raw captures of 12 bits; the scenes are ImageNet's originals of all sizes, displayed and compared at 384 x 384.
    "phlatcam": Kind(
        list_phlatcam,
        Layout("imagenet_caps_384_12bit_Feb_19", "orig", scene_size=(384, 384)),
        raw_frames=FrameFormat(bit_depth=12, mosaic="rggb"),
        place=centre,
    ),
    "folders": Kind(list_folders, Layout("captures", "scenes")),
    "parquet": Kind(list_parquet, Layout("lensless", "lensed")),
    "pairs": Kind(list_pair_file, Layout("measurement", "scene")),
}
"""Every kind that can be imported."""
