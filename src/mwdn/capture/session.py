"""A capture session: show a picture, let it settle, grab a frame, append the pair. It can be stopped and continued."""

import json
import math
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mwdn.capture.captured_pairs import SessionFile, create_captured, displayed_light, open_captured
from mwdn.capture.continuation import check_continued, describe_place
from mwdn.capture.display import Display
from mwdn.capture.gamma import fit_gamma
from mwdn.capture.grabber import Grabber
from mwdn.capture.patterns import grey, grey_levels, pattern, point
from mwdn.capture.photograph_list import list_photographs, read_photograph
from mwdn.capture.point_frames import Shooting, hot_pixels, record_point
from mwdn.capture.recipe import CaptureRecipe
from mwdn.capture.screen import Picture, Place, Screen, place_picture, put
from mwdn.capture.source import CameraFrame, CameraSource, check_like
from mwdn.data.pair_writer import check_path
from mwdn.errors import CameraError, ImageError, ParameterError
from mwdn.io.files import check_folder, existing_folder

SATURATED = 1e-3
"""Fraction of a white frame's pixels that may be saturated (hot pixels)."""

MIN_WHITE = 0.005
"""Smallest difference of the means of white and dark frames, over the full scale."""

GAMMA_ERROR = 0.03
"""Largest difference of a grey step from the fit without a warning."""

ROOM = 1.02
"""Bytes of a file over those of its pictures."""

Progress = Callable[[int, int, str], None]
"""Called with the pairs that are done, of how many, and the last photograph."""


class Session:
    """One session, which `run` starts or continues.

    Args:
        recipe: what to show and how.
        camera: open; opened again if it fails.
        display: in front of it.
        out: file of pairs, ending in .h5; an existing one of this recipe is continued.
        wait: sleeps for a number of seconds.
        progress: see `Progress`.
        lamp: switches the point source of [point] on or off, or has a person do it.
    """

    def __init__(
        self,
        recipe: CaptureRecipe,
        camera: CameraSource,
        display: Display,
        out: Path,
        *,
        wait: Callable[[float], None] = time.sleep,
        progress: Progress = lambda done, total, name: None,
        lamp: Callable[[bool], None] = lambda on: None,
    ) -> None:
        check_path(out)
        self.recipe, self.camera, self.display, self.out = recipe, camera, display, out
        self._wait, self._progress, self._lamp = wait, progress, lamp
        self._grabber = Grabber(camera, recipe.camera, recipe.session.skip, wait)
        self._first: CameraFrame | None = None
        self._screen: Screen = display.screen
        self._place: Place = place_picture(self._screen, recipe.pictures.size, recipe.pictures.fill)
        self._gamma = 1.0
        if recipe.point.frames and not recipe.point.lamp:
            point(self._screen, recipe.point.size_cm)  # refuses one that is too large before anything is recorded

    def run(self) -> int:
        """Capture what is left; returns how many pairs the file has.

        Raises:
            CameraError: the camera failed `attempts` times, delivers other frames, or is overexposed.
            DisplayError: the page does not show what it should.
            ImageError: the disk.
            ParameterError: the file was begun with other settings, or there is no room on the disk.
        """
        self._grabber.configure()
        self.display.show(self._whole(0))
        self._first = self._grabber.first()
        if self.out.exists():
            with open_captured(self.out) as pairs:
                check_continued(pairs, self.recipe, self._first, self._screen, self._place)
                return self._capture(pairs)
        photographs = len(self._names([]))
        self._check_room(min(photographs, self.recipe.pictures.count or photographs))
        with create_captured(self.out, self._first, self.recipe.pictures.size, self._attributes()) as pairs:
            return self._capture(pairs)

    def _capture(self, pairs: SessionFile) -> int:
        planned, taken = pairs.planned, pairs.names
        new = self._names(planned)
        pairs.plan(new)
        planned += new
        if count := self.recipe.pictures.count:
            planned = planned[:count]
            if len(planned) < count:
                warnings.warn(
                    f"`count` ({count}) of [pictures] is more than the photographs of `{self.recipe.photographs}` "
                    f"({len(planned)}).",
                    stacklevel=2,
                )
        start = planned.index(taken[-1]) + 1 if taken and taken[-1] in planned else len(taken)
        self._check_room(len(planned) - start)
        self._calibrate(pairs)
        for number, name in enumerate(planned[start:], start):
            picture = self._read(name)
            if picture is not None:
                self._take_references(pairs)
                frame = self._frame_of(put(picture, self._place, self._screen))
                pairs.append(frame, displayed_light(picture, self._gamma), name)
            self._progress(number + 1, len(planned), name)
        return len(pairs)

    def _names(self, planned: list[str]) -> list[str]:
        return list_photographs(self.recipe.photographs, self.recipe.pictures.seed, planned)

    def _read(self, name: str) -> Picture | None:
        """A photograph; ``None``, with a warning, for one that cannot be read."""
        try:
            return read_photograph(self.recipe.photographs / name, self.recipe.pictures.size)
        except ImageError as error:
            warnings.warn(f"{error} It is skipped.", stacklevel=2)
            return None

    # The display

    def _whole(self, level: int) -> Picture:
        return grey(level, (self._screen.height_px, self._screen.width_px))

    def _frame_of(self, picture: Picture) -> CameraFrame:
        """Show a picture, let it settle, and grab a frame of it."""
        shown = self.display.show(picture)
        self._wait(self.recipe.session.settle_s)
        frame = self._grabber.after(shown, self.recipe.session.settle_s)
        if self._first is not None:
            check_like(frame, self._first, self.camera.name)
        return frame

    def _series(self, first: CameraFrame, count: int) -> list[CameraFrame]:
        """So many frames of one picture, of which the first is there."""
        frames = [first, *(self._grabber.another() for _ in range(count - 1))]
        for frame in frames:
            check_like(frame, first, self.camera.name)
        return frames

    # Calibration of camera and display

    def _calibrate(self, pairs: SessionFile) -> None:
        """Capture the point source, grey steps and patterns, unless an earlier run has."""
        if not pairs.has_pattern("grey"):
            levels = grey_levels()
            frames = [self._frame_of(self._whole(level)) for level in levels]
            self._check_exposure(frames[0], frames[-1])
            self._gamma = self.recipe.display.gamma or self._measured_gamma(levels, frames)
            pairs.set_attributes({"display_gamma": self._gamma})
            size = self.recipe.pictures.size
            pairs.add_pattern("grey", frames, [displayed_light(grey(v, size), self._gamma) for v in levels])
        self._gamma = float(pairs.attributes["display_gamma"])
        shooting = Shooting(self.camera, self._screen, self._frame_of, self._grabber.after, self._series, self._lamp)
        usual_s = self.recipe.camera.exposure_s or (math.nan if self._first is None else self._first.exposure_s)
        record_point(pairs, self.recipe.point, shooting, usual_s=usual_s)
        for name in self.recipe.session.shown:
            if not pairs.has_pattern(name):
                picture = pattern(name, self.recipe.pictures.size)
                first = self._frame_of(put(picture, self._place, self._screen))
                frames = self._series(first, self.recipe.session.frames)
                pairs.add_pattern(name, frames, [displayed_light(picture, self._gamma)] * len(frames))

    def _measured_gamma(self, levels: list[int], frames: list[CameraFrame]) -> float:
        fit = fit_gamma(levels, [float(frame.array.mean()) for frame in frames])
        if fit.error > GAMMA_ERROR:
            warnings.warn(
                f"The display's light differs from a power of {fit.gamma:.2f} by up to {fit.error:.0%} of white. "
                "Switch dynamic contrast, night light and automatic exposure off.",
                stacklevel=2,
            )
        return fit.gamma

    def _check_exposure(self, dark: CameraFrame, white: CameraFrame) -> None:
        full = 2**white.bit_depth - 1
        part = float(((white.array >= full) & ~hot_pixels([dark])).mean())
        if part > SATURATED:
            raise CameraError(
                f"A white display saturates {part:.1%} of the camera's pixels. Lower `exposure_s` "
                f"({white.exposure_s:g}) of [camera], or `gain`, by half."
            )
        contrast = (float(white.array.mean()) - float(dark.array.mean())) / full
        if contrast < MIN_WHITE:
            raise CameraError(
                f"A white display is brighter than a dark one by {contrast:.2%} of the full scale only. Turn the "
                f"camera to the display, or raise `exposure_s` ({white.exposure_s:g}) of [camera]."
            )

    def _take_references(self, pairs: SessionFile) -> None:
        """Ambient and white frames every `references_every` pairs, with a warning if the light has drifted."""
        every = self.recipe.session.references_every
        if not every or len(pairs) % every:
            return
        if pairs.references("white")[0][-1:] == [len(pairs)]:
            return  # taken just before an earlier run was stopped
        frames = {name: self._frame_of(self._whole(level)) for name, level in (("ambient", 0), ("white", 255))}
        pairs.add_references(frames)
        (_, ambient), (_, white) = pairs.references("ambient"), pairs.references("white")
        light = white[0] - ambient[0]
        for what, change in (
            ("display's light", (white[-1] - ambient[-1]) / light - 1),
            ("room's light", (ambient[-1] - ambient[0]) / light),
        ):
            if abs(change) > self.recipe.session.drift:
                warnings.warn(
                    f"The {what} has changed by {change:+.1%} of white since the start, at pair {len(pairs):,}. Let "
                    "the display warm up; darken the room; keep the exposure fixed.",
                    stacklevel=2,
                )

    # The file

    def _attributes(self) -> dict[str, Any]:
        recipe = asdict(self.recipe)
        recipe["display"].pop("token")
        return {
            "camera": self.camera.name,
            **describe_place(self._screen, self._place),
            "recipe": json.dumps(recipe, default=str),
        }

    def _check_room(self, count: int) -> None:
        if self._first is None or count <= 0:
            return
        every = self.recipe.session.references_every
        height, width = self.recipe.pictures.size
        table = self.recipe.point
        references = (2 * math.ceil(count / every) if every else 0) + (2 * table.exposures + 3) * table.frames
        needed = ROOM * (
            count * (self._first.array.nbytes + height * width * 6) + references * self._first.array.nbytes
        )
        folder = self.out.absolute().parent
        check_folder(folder)
        free = shutil.disk_usage(existing_folder(folder)).free
        if needed > free:
            raise ParameterError(
                f"{count:,} pairs need {needed / 1e6:,.0f} MB, but `{folder}` has {free / 1e6:,.0f} MB left. "
                "Make room, choose another folder for `out`, or a smaller `count` or `size` of [pictures]."
            )
