"""Imported captures and scenes, as pairs of one size and scale."""

from dataclasses import replace

import numpy as np

from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.float_scale import check_float_scale
from mwdn.calibration.frame_format import changed_fields
from mwdn.data.kinds import Kind, Layout
from mwdn.data.pair_writer import quantise
from mwdn.data.scene_place import bin_scene, place_scene, resize_scene
from mwdn.data.sources import Source
from mwdn.errors import ImageError, ParameterError
from mwdn.types import Frame, Size


def convert_pair(
    source: Source, kind: Kind, layout: Layout, changes: FrameFormat, camera: Calibration | None
) -> tuple[Frame, Frame]:
    """Load a pair as RGB, row 0 at the top, both with the capture's channels, in the smallest type exact for both."""
    stored, name = source.load(), source.name
    raw, scene = stored.capture, stored.scene
    usual = kind.raw_frames if kind.raw_frames is not None and raw.shape[2] == 1 else kind.frames
    frames = replace(usual, **changed_fields(changes)).with_mosaic(stored.mosaic, of=f"`{name}`")
    if frames.bgr:
        raw, scene = (np.ascontiguousarray(frame[..., ::-1]) for frame in (raw, scene))
    capture = _upright(_correct_levels(raw, frames, name, camera), frames)
    scene = _upright(_convert_scene(scene, layout, capture.shape[2], name), frames)
    full_size, whole = (each.full_size(raw) for each in (frames, replace(frames, crop=None)))
    place = _place(kind, layout, (scene.shape[0], scene.shape[1]), full_size, whole)
    if place is not None:
        scene = bin_scene(place_scene(scene, full_size, place, name), frames.bin)

    flat = camera is not None and camera.corrections.flat is not None
    shifted = flat or (camera is not None and camera.offset is not None)
    floats = shifted or "f" in (raw.dtype.kind, stored.scene.dtype.kind)
    dtype = np.dtype("float32" if floats else "uint8" if capture.dtype == scene.dtype == np.uint8 else "uint16")
    return quantise(capture, dtype, f"capture of {name}", has_flat=flat), quantise(scene, dtype, f"scene of {name}")


def _convert_scene(scene: Frame, layout: Layout, channels: int, name: str) -> Frame:
    """A scene in linear light and its size, with the capture's channels: the mean of its colours, or equal colours."""
    scene = _correct_levels(scene, FrameFormat(gamma=layout.scene_gamma, grey=channels == 1 < scene.shape[2]), name)
    if scene.shape[2] == 1 < channels:  # a few of ImageNet's photographs are grey
        scene = scene.repeat(3, axis=2)
    return scene if layout.scene_size is None else resize_scene(scene, layout.scene_size)


def _place(kind: Kind, layout: Layout, scene: Size, frame: Size, whole: Size) -> Size | None:
    """Where a scene is in the frame, the middle of the whole one; ``None`` if it is not placed."""
    if layout.scene_place is not None:
        return layout.scene_place
    if scene == frame:
        return 0, 0
    if kind.place is None or scene[0] > whole[0] or scene[1] > whole[1]:
        return None
    place = kind.place(scene, whole)
    return place and (place[0] + frame[0] // 2 - whole[0] // 2, place[1] + frame[1] // 2 - whole[1] // 2)


def _correct_levels(frame: Frame, frames: FrameFormat, name: str, camera: Calibration | None = None) -> Frame:
    """Apply every step of the format but channel order and orientation; without any, the numbers stay as stored."""
    if frames.bit_depth is not None and frames.bit_depth > 8 * frame.dtype.itemsize:
        raise ImageError(f"The capture of `{name}` has {frame.dtype}, fewer than {frames.bit_depth} bits.")
    if frames.bit_depth is not None:
        check_float_scale(frame, frames.bit_depth)
    steps = replace(frames, bgr=False, upside_down=False)
    if camera is None:
        return frame if steps == FrameFormat() else steps.to_measurement(frame)[0].movedim(0, -1).numpy()
    if camera.offset is not None:
        _check_scale(camera.frames, frames)
    measurement = steps.to_measurement(frame, camera.offset, camera.corrections.of_capture)
    return measurement[0].movedim(0, -1).numpy()


def _check_scale(own: FrameFormat, frames: FrameFormat) -> None:
    """Raise a `ParameterError` if the camera's dark frame was read on another scale than captures of this format."""
    for key in ("bit_depth", "gamma", "mosaic"):
        wanted, got = getattr(frames, key), getattr(own, key)
        if wanted != got:
            raise ParameterError(
                f"`{key}` of the camera ({got}), in which its dark or ambient frame was read, must be that of the "
                f"captures ({wanted}). State it in the camera file."
            )


def _upright(frame: Frame, frames: FrameFormat) -> Frame:
    """Row 0 at the top."""
    return frame[::-1] if frames.upside_down else frame


def check_like_first(first: tuple[Frame, Frame], pair: tuple[Frame, Frame], name: str) -> None:
    """Raise an `ImageError` if a pair, from the source of this name, has other axes or types than the first one."""
    for what, expected, got in zip(("capture", "scene"), first, pair, strict=True):
        if expected.shape != got.shape or expected.dtype != got.dtype:
            actual, wanted = (f"{' x '.join(map(str, frame.shape))}, {frame.dtype}" for frame in (got, expected))
            if expected.shape == got.shape:
                advice = "Captures and scenes together must have 8 bits, 16 bits or floats in all pairs: convert them."
            elif expected.shape[:2] == got.shape[:2]:
                advice = "All captures must be in colour, or all grey: convert them, or give `--grey`."
            else:
                advice = "Convert it, or for scenes of several sizes give `--scene-size 384 384`."
            raise ImageError(
                f"The {what} of `{name}` ({actual}) must be like that of the first pair ({wanted}). {advice}"
            )
