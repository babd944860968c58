"""Camera and display of a recipe."""

from collections.abc import Callable
from dataclasses import asdict

from mwdn.capture.display import Display, RigDisplay
from mwdn.capture.page import PageDisplay
from mwdn.capture.patterns import grey
from mwdn.capture.recipe import CaptureRecipe
from mwdn.capture.rig import Rig
from mwdn.capture.screen import Screen
from mwdn.capture.source import CameraSource
from mwdn.capture.sources import open_source, parse_source
from mwdn.io.toml import to_dataclass

LAMP = 1e5
"""Luminance of the rig's lamp over that of its white display: a power LED to 300 cd/m^2."""


def open_camera(recipe: CaptureRecipe) -> CameraSource:
    """The camera of a recipe; a ``with`` statement opens it."""
    table, display = recipe.camera, recipe.display
    name, _, options = parse_source(table.source)
    if name != "rig":
        camera = open_source(table.source)
        if "timeout_s" not in options:  # of the camera's own string, which a plugin's camera need not take
            camera.timeout_s = table.timeout_s
        return camera
    screen = Screen(
        width_px=display.width_px,
        height_px=display.height_px,
        width_cm=display.width_cm,
        height_cm=display.height_cm,
        distance_cm=display.distance_cm,
    )
    return Rig(to_dataclass(type(recipe.rig), "rig", {**asdict(recipe.rig), **options}), screen)


def open_lamp(camera: CameraSource, ask: Callable[[str], None]) -> Callable[[bool], None]:
    """A function that switches the point source of a session: the simulated rig's lamp, or a person is asked.

    Args:
        camera: of the session.
        ask: says what a person has to do; returns when it is done.
    """
    if isinstance(camera, Rig):
        black = grey(0, (camera.screen.height_px, camera.screen.width_px))
        return lambda on: camera.show(black, lamp=LAMP * on)
    return lambda on: ask(f"Switch the point source {'on' if on else 'off'}")


def open_display(recipe: CaptureRecipe, camera: CameraSource, tell: Callable[[str], None]) -> Display:
    """The display of a recipe; waits until a page is open on it.

    Args:
        recipe: of the session.
        camera: of the session.
        tell: called with what a person has to do.
    """
    if isinstance(camera, Rig):
        return RigDisplay(camera)
    table = recipe.display
    display = PageDisplay(
        width_cm=table.width_cm,
        height_cm=table.height_cm,
        distance_cm=table.distance_cm,
        host=table.host,
        port=table.port,
        token=table.token,
        show_s=table.show_s,
    )
    tell(f"Open {display.url} in a browser on the display in front of the camera, full-screen.")
    try:
        screen = display.wait()
    except BaseException:
        display.close()
        raise
    tell(f"The display has {screen.width_px} x {screen.height_px} pixels.")
    return display
