"""The command `mwdn design`: a mask and its PSF from a few parameters."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter
from cyclopts.config import Toml

from mwdn.cli.terminal import quoted, say, warn
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.files import check_folder, refuse_overwrite
from mwdn.io.toml import find_recipe
from mwdn.optics import MASKS, ArrayMask, Setup
from mwdn.optics.masks import MaskDesign


def _recipe(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """Read options that the command line does not set from the file of ``--recipe``."""
    for argument in arguments:
        if argument.name == "--recipe" and argument.tokens:
            Toml(find_recipe(argument.tokens[0].value), use_commands_as_keys=False)(app, commands, arguments)
            return


design = App(
    name="design",
    help="Design a mask and compute the PSF of a camera with it.\n\nYour own mask: mwdn design --mask array.npy, short "
    "for mwdn design array --mask array.npy.",
    config=_recipe,
)


@Parameter(name="*")
@dataclass(frozen=True)
class Output:
    """Which files are written, and where."""

    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera")
    """Folder for mask.tif, psf.tif, camera.json and preview.png."""
    recipe: Path | None = None
    """TOML file with options of this command, or a recipe of the package, such as camera-mwdn; options on the command
    line take precedence."""
    sensitivity: bool = False
    """Compare the PSFs of nearer, farther and off-axis points with this one. Takes several times as long."""
    gds: bool = False
    """Also write mask.gds: one layer per lithography mask."""
    stl: bool = False
    """Also write mask.stl: a closed body in um; phase masks only."""
    stl_every: int = 1
    """Use every n-th sample along each axis for the STL, which can have 4 million samples."""

    def write(self, name: str, mask: MaskDesign, setup: Setup) -> None:
        """Compute the mask and its PSF, write the files, print a summary."""
        from mwdn.optics.design import check_replaced, design_camera
        from mwdn.optics.mask_files import check_stl, write_gds, write_stl

        if self.stl_every < 1:
            raise ParameterError(f"`stl_every` ({self.stl_every}) must be at least 1.")
        if self.stl_every != 1 and not self.stl:
            raise ParameterError("`stl_every` needs `stl`. Give it, too, or leave `stl_every` out.")
        check_replaced(self.out, gds=self.gds, stl=self.stl)
        check_folder(self.out)
        designed = design_camera(name, mask, setup)
        if self.stl:
            check_stl(designed.mask, every=self.stl_every)
        designed.write(self.out, sensitive=self.sensitivity)
        if self.gds:
            write_gds(self.out / "mask.gds", designed.mask)
        if self.stl:
            write_stl(self.out / "mask.stl", designed.mask, every=self.stl_every)
        for option, written in (("gds", self.gds), ("stl", self.stl)):
            old = self.out / f"mask.{option}"
            if old.exists() and not written:
                warn(f"`{old}` is from before, and may be of another mask. Write it again: `--{option}`.")
        made = designed.report()["made"]
        light = ", ".join(f"{part:.1%}" for part in made["light_on_sensor"])
        field = " x ".join(f"{angle:.0f}" for angle in made["field_degrees"])
        say(
            f"PSF {made['psf_hash']}: {light} of the aperture's light on the sensor, resolution "
            f"{made['resolution_mrad']:.1f} mrad, field {field} degrees. Use it: "
            f"--psf {quoted(self.out / 'psf.tif')} --background 0",
        )


Flat = Parameter(name="*")
"""Makes each field of a dataclass an option of the command."""


def _add_command(name: str, kind: type[MaskDesign]) -> None:
    """Add the command of one kind of mask; the fields of the mask and of the setup are its options."""
    default = kind()

    def command(
        *,
        mask: Annotated[kind, Flat] = default,  # type: ignore[valid-type]
        setup: Annotated[Setup, Flat] = Setup(),
        output: Output = Output(),
    ) -> None:
        output.write(name, mask, setup)

    design.command(command, name=name, help=(kind.__doc__ or "").partition("\n")[0])


for _name, _kind in MASKS.own.items():
    _add_command(_name, _kind)


def add_plugins(words: Collection[str]) -> None:
    """Add the commands of the masks of plugins, unless the command line names a mask of this package.

    Raises:
        ParameterError: the command line names the mask of a plugin that cannot be loaded.
    """
    if not {*MASKS.own, "array"}.isdisjoint(words):
        return
    for word in words:
        if word in MASKS:
            _ = MASKS[word]
    for name in MASKS:
        if name not in {*MASKS.own, *design}:
            _add_command(name, MASKS[name])


@design.command
def array(
    *,
    mask: Annotated[ArrayMask, Flat],
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """The PSF of a mask from a file: heights, phases, amplitudes or transmissions."""
    refuse_overwrite(output.out / "mask.tif", mask.mask)
    output.write("array", mask, setup)


@design.default
def default(*tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)]) -> None:
    """Print the help, or refuse an unknown kind of mask."""
    if tokens and tokens[0].startswith("-"):
        raise ParameterError(
            f"Unknown option: {tokens[0]}. Name the mask first, then its options: `mwdn design --help`."
        )
    if tokens:
        raise UnknownNameError("mask", tokens[0], [*MASKS, "array"])
    design.help_print()
