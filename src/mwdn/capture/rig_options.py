"""Options of the simulated rig."""

from dataclasses import dataclass, replace
from typing import get_args

from mwdn.data.mismatch import EXACT, Mismatch
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.raw import Mosaic


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """The [rig] of a recipe: the true camera, its display's pose, and what goes wrong.

    Args:
        seed: of all randomness: two rigs of one seed deliver the same frames.
        height: pixels of a measurement; raw frames of a mosaic have twice as many.
        width: likewise.
        family: kind of the mask, see `mwdn.optics.FAMILIES`; drawn if empty.
        mosaic: colours of a 2 x 2 cell of raw frames, ``"rggb"``; RGB frames if empty.
        fill: width of the display in the camera's view, over the frame's.
        tilt_degrees: see `DisplayPose`.
        turn_degrees: see `DisplayPose`.
        offset_cm: see `DisplayPose`.
        display_gamma: light of the display is the coded number to this power.
        display_black: light of a black pixel of the display, over that of a white one.
        white: brightest pixel of a frame of a white display at `EXPOSURE_S`, over the full scale.
        room_light: see `mwdn.data.mismatch.Mismatch`, as are the next five; relative to a white display. Each is fixed.
        envelope_shift: likewise.
        tails: likewise: stray light.
        off_axis: likewise; takes five times as long.
        hot_pixels: likewise.
        vignetting: likewise.
        full_well: of the sensor in electrons at a gain of 1, see `mwdn.optics.Sensor`.
        read_noise: in electrons.
        bit_depth: of the sensor.
        black_level: of the sensor.
        drift: standard deviation of the step by which the exposure's logarithm changes from frame to frame.
        drop: probability that a frame is lost.
        disconnect_every: frames after which the camera is disconnected, until it is opened again; 0 for never.
        latency: frames after a change of the display that still show some of the picture before (a rolling shutter).
        fps: frames per second; 0 for no waiting.
        prepared: frames of each picture that are exposed once and then repeated, so that a fast rig takes no time of
            the computer that shows it; 0 exposes each. Not with `drift` or `latency`.

    Raises:
        ParameterError: a number is outside its range.
    """

    seed: int = 0
    height: int = 160
    width: int = 160
    family: str = "contours"
    mosaic: str = ""
    fill: float = 0.6
    tilt_degrees: tuple[float, float] = (4.0, -6.0)
    turn_degrees: float = -1.3
    offset_cm: tuple[float, float] = (0.6, -0.4)
    display_gamma: float = 2.2
    display_black: float = 0.001
    white: float = 0.7
    room_light: float = 0.02
    envelope_shift: float = 0.0
    tails: float = 0.0
    off_axis: float = 0.0
    hot_pixels: float = 0.0
    vignetting: float = 0.0
    full_well: float = 15_000.0
    read_noise: float = 3.0
    bit_depth: int = 12
    black_level: float = 0.01
    drift: float = 0.0
    drop: float = 0.0
    disconnect_every: int = 0
    latency: int = 0
    fps: float = 0.0
    prepared: int = 0

    def __post_init__(self) -> None:
        if self.mosaic and self.mosaic not in get_args(Mosaic):
            raise UnknownNameError("mosaic", self.mosaic, get_args(Mosaic))
        for name in ("fill", "white", "display_gamma"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) of the rig must be positive.")
        if not 0 <= self.drop < 1:
            raise ParameterError(f"`drop` ({self.drop}) must be in [0, 1): a probability.")
        if not self.display_black < 1:
            raise ParameterError(f"`display_black` ({self.display_black}) must be below 1, the light of a white pixel.")
        for name in ("drift", "disconnect_every", "latency", "fps", "display_black", "prepared"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) of the rig must not be negative.")
        if self.prepared and (self.drift or self.latency):
            raise ParameterError(f"`prepared` ({self.prepared}) repeats frames: leave out `drift` and `latency`.")

    @property
    def mismatch(self) -> Mismatch:
        """How the true camera differs from a plain convolution."""
        names = ("room_light", "envelope_shift", "tails", "off_axis", "hot_pixels", "vignetting")
        return replace(EXACT, full=True, **{name: getattr(self, name) for name in names})
