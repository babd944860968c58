"""The recipe of a capture session: one TOML file."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mwdn.arguments import check_not_negative
from mwdn.capture.patterns import PATTERNS, check_size
from mwdn.capture.rig_options import RigOptions
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.toml import check_table, find_recipe, read_toml, to_dataclass


@dataclass(frozen=True)
class CameraTable:
    """The [camera] of a recipe.

    Args:
        source: as for `mwdn.capture.open_source`.
        exposure_s: 0 leaves it as the camera is set.
        gain: in the camera's unit; below 0 it is left as the camera is set.
        timeout_s: seconds to wait for a frame, besides its exposure.
        attempts: how often a camera that fails is opened again, or a damaged frame passed over, before the session
            ends.
    """

    source: str = "rig"
    exposure_s: float = 0.0
    gain: float = -1.0
    timeout_s: float = 5.0
    attempts: int = 3

    def __post_init__(self) -> None:
        if not self.timeout_s > 0 or self.attempts < 0 or self.exposure_s < 0:
            raise ParameterError(
                f"`timeout_s` ({self.timeout_s:g}) must be positive, `attempts` ({self.attempts}) and `exposure_s` "
                f"({self.exposure_s:g}) not negative."
            )


@dataclass(frozen=True)
class DisplayTable:
    """The [display] of a recipe.

    Args:
        kind: ``page``, a browser page; or ``rig``, the simulated rig's.
        width_cm: lit width of the display.
        height_cm: lit height.
        distance_cm: from the camera to the display.
        gamma: light of the display is the coded number to this power; 0 measures it with grey steps.
        host: address that the page is served at; others than 127.0.0.1 need a token.
        port: of the page.
        token: secret in the page's address.
        show_s: seconds in which a picture must be shown.
        width_px: of the rig's display; a page says its own.
        height_px: likewise.
    """

    kind: str = "page"
    width_cm: float = 48.0
    height_cm: float = 27.0
    distance_cm: float = 20.0
    gamma: float = 0.0
    host: str = "127.0.0.1"
    port: int = 8765
    token: str = ""
    show_s: float = 30.0
    width_px: int = 480
    height_px: int = 270

    def __post_init__(self) -> None:
        if self.kind not in ("page", "rig"):
            raise UnknownNameError("kind", self.kind, ("page", "rig"))
        if self.gamma and not 1 <= self.gamma <= 4:
            raise ParameterError(f"`gamma` ({self.gamma}) must be from 1 to 4, or 0 to measure it.")


@dataclass(frozen=True)
class PointTable:
    """The [point] of a recipe: frames for `mwdn calibrate`, at the start of the session.

    Args:
        frames: of each kind at each exposure, see `mwdn.capture.point_frames`; 0 for none. An odd number counts as the
            next even one.
        lamp: whether the point is a lamp behind a pinhole that a person switches on and off, instead of one on the
            display: brighter than the room and than black pixels.
        size_cm: side of the point on the display. A larger one has more light, and blurs the PSF by its size in the
            camera's view.
        exposures: of the point, for high dynamic range.
        ratio: of each exposure to the one before.
        most_s: longest exposure in seconds of the shortest one, if the point stays faint.
    """

    frames: int = 0
    lamp: bool = False
    size_cm: float = 0.1
    exposures: int = 2
    ratio: float = 8.0
    most_s: float = 10.0

    def __post_init__(self) -> None:
        if not 0 <= self.frames <= 1000 or not 1 <= self.exposures <= 4:
            raise ParameterError(
                f"`frames` ({self.frames}) must be from 0 to 1,000, and `exposures` ({self.exposures}) from 1 to 4."
            )
        for name, least in (("size_cm", 0.0), ("ratio", 1.0), ("most_s", 0.0)):
            if not getattr(self, name) > least:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be above {least:g}.")


@dataclass(frozen=True)
class PicturesTable:
    """The [pictures] of a recipe.

    Args:
        folder: of photographs, searched with its subfolders; relative to the recipe.
        count: pictures to capture; 0 for all.
        size: height and width in pixels of the pictures as shown and stored: the central part of each photograph.
        fill: part of the display's width or height that they fill.
        seed: of their order.
    """

    folder: str = "photos"
    count: int = 0
    size: tuple[int, int] = (256, 256)
    fill: float = 0.8
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.size) < 8 or max(self.size) > 4096:
            raise ParameterError(f"`size` {self.size} must be from 8 to 4,096 pixels.")
        if self.count < 0:
            raise ParameterError(f"`count` ({self.count}) must not be negative; 0 is for all.")


@dataclass(frozen=True)
class SessionTable:
    """The [session] of a recipe.

    Args:
        settle_s: seconds between a picture's confirmation and the frame: the display's response, a few frames at least.
        skip: frames that are read and not used after a picture has changed; 1 empties the driver's queue.
        references_every: pictures between ambient (dark display) and white frames; 0 for none.
        drift: relative change of the white frames' light, or of the ambient light over it, that causes a warning.
        patterns: of `mwdn.capture.patterns.PATTERNS`, captured at the start: they find the camera. Dots and a ChArUco
            board unless given; ``["none"]`` for none.
        frames: that are captured of each pattern.
    """

    settle_s: float = 0.2
    skip: int = 1
    references_every: int = 100
    drift: float = 0.03
    patterns: tuple[str, ...] = ()
    frames: int = 4

    def __post_init__(self) -> None:
        for name in self.shown:
            if name not in PATTERNS:
                raise UnknownNameError("pattern", name, PATTERNS)
        check_not_negative(settle_s=self.settle_s, skip=self.skip, references_every=self.references_every)
        if not self.drift > 0 or self.frames < 1:
            raise ParameterError(f"`drift` ({self.drift}) and `frames` ({self.frames}) must be positive.")

    @property
    def shown(self) -> tuple[str, ...]:
        """The patterns to capture."""
        return () if self.patterns == ("none",) else self.patterns or ("dots", "charuco")


@dataclass(frozen=True)
class CaptureRecipe:
    """A capture session.

    Args:
        camera: see `CameraTable`.
        display: see `DisplayTable`.
        pictures: see `PicturesTable`.
        session: see `SessionTable`.
        point: see `PointTable`.
        rig: see `RigOptions`; for ``source = "rig"``.
        folder: to which paths are relative: that of the recipe.

    Raises:
        ParameterError: the pictures are too small for a pattern.
    """

    camera: CameraTable = CameraTable()
    display: DisplayTable = DisplayTable()
    pictures: PicturesTable = PicturesTable()
    session: SessionTable = SessionTable()
    point: PointTable = PointTable()
    rig: RigOptions = RigOptions()
    folder: Path = Path()

    def __post_init__(self) -> None:
        for name in self.session.shown:
            check_size(name, self.pictures.size)

    @property
    def photographs(self) -> Path:
        """Folder of the photographs."""
        return self.folder / self.pictures.folder


TABLES: dict[str, Any] = {
    field.name: type(field.default) for field in dataclasses.fields(CaptureRecipe) if field.name != "folder"
}


def read_capture_recipe(path: str | Path, **changes: Any) -> CaptureRecipe:  # noqa: ANN401
    """Read a recipe.

    Args:
        path: name of a recipe of the package, or TOML file with the tables of `CaptureRecipe`.
        **changes: replace values: ``pictures={"count": 50}``. Their folder is relative to the current one.

    Raises:
        ParameterError: the file cannot be read, or a value is outside its range.
        UnknownNameError: no such table or key.
    """
    path = find_recipe(path)
    content = read_toml(path)
    for table in [*content, *changes]:
        if table not in TABLES:
            raise UnknownNameError("table of a capture recipe", table, TABLES)
        stored, changed = (check_table(part.get(table, {}), table) for part in (content, changes))
        content[table] = stored | changed
    tables = {name: to_dataclass(TABLES[name], name, table) for name, table in content.items()}
    is_given = "folder" in changes.get("pictures", {})
    recipe = CaptureRecipe(**tables, folder=Path() if is_given else path.parent)
    if (recipe.camera.source.split(",")[0] == "rig") != (recipe.display.kind == "rig"):
        raise ParameterError(
            "The rig's camera sees the rig's display alone: [camera] source and [display] kind \"rig\"."
        )
    return recipe
