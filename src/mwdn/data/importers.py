"""From a public data set, in its own layout, to a file of pairs."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np

from mwdn.calibration.frames import as_image, bin_pixels, demosaiced, full_scale
from mwdn.data.pair_writer import PixelType, check_path, quantise
from mwdn.data.pairs import PairFile
from mwdn.data.sources import Found, Source, find_in_folders, find_in_hdf5, find_in_parquet, find_phlatcam
from mwdn.errors import ImageError, MwdnError, ParameterError, UnknownNameError
from mwdn.io.files import refuse_overwrite
from mwdn.types import Frame, Size

Pair = tuple[str, Frame, Frame]
"""A name, a measurement and a scene, both (H, W, C), RGB, row 0 at the top, integers or floats in [0, 1]."""


@dataclass(frozen=True)
class Layout:
    """How a data set stores its pairs; ``None`` where it says nothing.

    Args:
        captures: folder, data set or column of the measurements.
        scenes: folder, data set or column of the ground truth.
        bit_depth: of the captures, where their numbers do not fill the file's type.
        scene_size: height and width to which scenes are resized, where they are not all of one size.
        bgr: the channels of both are blue, green, red.
        upside_down: the first row of both is the picture's last.
        bin: average blocks of so many pixels of a capture along each axis.

    Raises:
        ParameterError: a number is outside its range.
    """

    captures: str | None = None
    scenes: str | None = None
    bit_depth: int | None = None
    scene_size: Size | None = None
    bgr: bool = False
    upside_down: bool = False
    bin: int = 1

    def __post_init__(self) -> None:
        if self.bit_depth is not None and not 1 <= self.bit_depth <= 16:
            raise ParameterError(f"`bit_depth` ({self.bit_depth}) must be 1 to 16.")
        if self.scene_size is not None and min(self.scene_size) < 1:
            height, width = self.scene_size
            raise ParameterError(f"`scene_size` ({height} x {width}) must be positive: `--scene-size 384 384`.")
        if self.bin < 1:
            raise ParameterError(f"`bin` ({self.bin}) must be at least 1.")

    def over(self, usual: "Layout") -> "Layout":
        """Fill what is not said here with what is usual."""
        return Layout(
            self.captures or usual.captures,
            self.scenes or usual.scenes,
            self.bit_depth or usual.bit_depth,
            self.scene_size or usual.scene_size,
            self.bgr or usual.bgr,
            self.upside_down or usual.upside_down,
            self.bin,
        )


@dataclass(frozen=True)
class Kind:
    """A kind of data set: how its pairs are found, their usual layout, and the bits of raw captures if it has them."""

    find: Callable[[Path, str, str], Found]
    usual: Layout
    mosaic_bits: int = 0


KINDS = {
    # The paper's own: what OpenCV read, channels first.
    "mwdn": Kind(find_in_hdf5, Layout("blur", "gt", bgr=True)),
    "diffusercam": Kind(find_in_folders, Layout("diffuser_images", "ground_truth_lensed", bgr=True, upside_down=True)),
    # Raw captures of 12 bits; the scenes are ImageNet's originals of all sizes, shown and compared at 384 x 384.
    "phlatcam": Kind(
        find_phlatcam,
        Layout("imagenet_caps_384_12bit_Feb_19", "orig", scene_size=(384, 384)),
        mosaic_bits=12,
    ),
    "folders": Kind(find_in_folders, Layout("captures", "scenes")),
    "parquet": Kind(find_in_parquet, Layout("lensless", "lensed")),
}
"""Every kind that can be imported."""


@dataclass
class Imported:
    """What an import did: pairs atomic_write, and the name of each that was left out with the reason."""

    count: int = 0
    skipped: dict[str, str] = field(default_factory=dict)


def read_pairs(
    kind: str,
    path: str | Path,
    *,
    layout: Layout = Layout(),
    skipped: dict[str, str] | None = None,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> Iterator[Pair]:
    """Read the pairs of a data set one by one, in its order.

    Measurement and scene are as stored, turned to RGB and upright; no gamma is decoded.

    Args:
        kind: of `KINDS`.
        path: of the data set: a file for ``"mwdn"``, a folder for the others.
        layout: what is unusual about this copy of it.
        skipped: takes the name of each damaged or unpaired one and the reason; without it, the first one raises.
        track: wraps the list of what will be read, for a progress bar.

    Raises:
        UnknownNameError: no such kind.
        ImageError: nothing there; or, without ``skipped``, a pair is damaged, incomplete, or unlike the first.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of data set", kind, KINDS)
    layout = layout.over(KINDS[kind].usual)
    found = KINDS[kind].find(Path(path), layout.captures or "", layout.scenes or "")
    if found.refused and skipped is None:
        reason = next(iter(found.refused.values()))
        more = f" (and {len(found.refused) - 1:,} more like it)" if len(found.refused) > 1 else ""
        raise ImageError(f"{reason}{more} To import the others: `--skip-damaged`.")
    if skipped is not None:
        skipped.update(found.refused)
    first: tuple[Frame, Frame] | None = None
    for source in track(found.sources):
        try:
            pair = _prepare(source, layout, KINDS[kind].mosaic_bits)
            first = first or pair
            _must_be_like(first, pair, source.name)
        except MwdnError as problem:
            reason = str(problem) if isinstance(problem, ImageError) else f"`{source.name}`: {problem}"
            if skipped is None:
                raise ImageError(f"{reason} To import the others: `--skip-damaged`.") from problem
            skipped[source.name] = reason
            continue
        yield source.name, *pair


def _prepare(source: Source, layout: Layout, mosaic_bits: int) -> tuple[Frame, Frame]:
    """Load a pair and turn it upright, into RGB, and into one type that loses nothing of either."""
    capture, scene = raw = source.load()
    mosaic = mosaic_bits > 0 and capture.shape[2] == 1
    bit_depth = layout.bit_depth or (mosaic_bits if mosaic else None)
    if mosaic_bits and scene.shape[2] == 1:
        scene = scene.repeat(3, axis=2)  # a few of ImageNet's photographs are grey
    if bit_depth or layout.bin > 1:
        if bit_depth and bit_depth > 8 * raw[0].dtype.itemsize:
            raise ImageError(f"The capture of `{source.name}` has {raw[0].dtype}, fewer than {bit_depth} bits.")
        image = as_image(capture, full_scale(capture, bit_depth))
        image = demosaiced(image, "rggb") if mosaic else image
        capture = bin_pixels(image, layout.bin)[0].movedim(0, -1).numpy()
    if layout.scene_size:
        scene = _resized(scene, layout.scene_size)
    shallow = capture.dtype == scene.dtype == np.uint8
    floats = any(frame.dtype.kind == "f" for frame in raw)
    dtype = np.dtype("float32" if floats else "uint8" if shallow else "uint16")
    rows, channels = slice(None, None, -1 if layout.upside_down else 1), slice(None, None, -1 if layout.bgr else 1)
    named = {"capture": capture, "scene": scene}
    capture, scene = (quantise(f[rows, :, channels], dtype, f"{n} of {source.name}") for n, f in named.items())
    return capture, scene


def _resized(scene: Frame, size: Size) -> Frame:
    import cv2

    if scene.shape[:2] == size:
        return scene
    shrinks = scene.shape[0] >= size[0] and scene.shape[1] >= size[1]
    resized = cv2.resize(scene, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(resized).reshape(*size, -1)


def _must_be_like(first: tuple[Frame, Frame], pair: tuple[Frame, Frame], name: str) -> None:
    for what, expected, got in zip(("capture", "scene"), first, pair, strict=True):
        if expected.shape != got.shape or expected.dtype != got.dtype:
            was, wanted = (f"{' x '.join(map(str, frame.shape))}, {frame.dtype}" for frame in (got, expected))
            raise ImageError(
                f"The {what} of `{name}` ({was}) must be like that of the first pair ({wanted}). Convert it, "
                "or for scenes of several sizes give `--scene-size 384 384`."
            )


def import_pairs(
    kind: str,
    path: str | Path,
    output: str | Path,
    *,
    layout: Layout = Layout(),
    skip_damaged: bool = False,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> Imported:
    """Turn a data set into a file of pairs, which appears when all of it is written.

    Pictures of 8 bits are stored as such, deeper or binned ones as 16 bits, floats as floats.

    Args:
        kind: of `KINDS`.
        path: of the data set.
        output: the new file, ending in .h5 or .hdf5; one that exists is replaced.
        layout: what is unusual about this copy of the data set.
        skip_damaged: leave out what is damaged or has no partner, and name it in the result.
        track: wraps the list of what will be read, for a progress bar.

    Raises:
        UnknownNameError: no such kind.
        ParameterError: ``output`` has another suffix, or is the data set itself.
        ImageError: nothing to import; a pair is damaged and not to be skipped; ``output`` cannot be written.
    """
    check_path(Path(output))
    refuse_overwrite(Path(output), Path(path))
    done = Imported()
    pairs = read_pairs(kind, path, layout=layout, skipped=done.skipped if skip_damaged else None, track=track)
    first = next(pairs, None)
    if first is None:
        left = f" {len(done.skipped):,} were skipped; {next(iter(done.skipped.values()))}" if done.skipped else ""
        raise ImageError(f"`{path}` has no pair to import.{left} For how it must be laid out: `mwdn import --help`.")
    with PairFile.create(
        output,
        measurement_shape=first[1].shape,
        scene_shape=first[2].shape,
        dtype=cast(PixelType, first[1].dtype.name),
        attributes={"source": kind},
    ) as file:
        for _, measurement, scene in chain([first], pairs):
            file.append(measurement, scene)
        done.count = len(file)
    return done
