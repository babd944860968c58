"""The commands for a camera that does not exist yet."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter
from cyclopts.config import Toml

from mwdn.cli.camera import console
from mwdn.errors import ParameterError
from mwdn.optics import CodedAperture, Contour, Diffuser, Lenslets, Pinholes, Setup, ZoneAperture
from mwdn.optics.masks import MaskDesign


def _recipe(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """What the file of ``--recipe`` says stands for what the command line does not."""
    for argument in arguments:
        if argument.name == "--recipe" and argument.tokens:
            path = Path(argument.tokens[0].value)
            if not path.is_file():
                raise ParameterError(f"`recipe` ({path}) must be a TOML file; see recipes/camera-*.toml.")
            Toml(path, use_commands_as_keys=False)(app, commands, arguments)
            return


design = App(
    name="design",
    help="Design a mask, and compute the PSF of the camera that has it.",
    config=_recipe,
    default_parameter=Parameter(negative_iterable=()),
)


@Parameter(name="*")
@dataclass(frozen=True)
class Output:
    """What is written, and where."""

    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera")
    """Folder for mask.tif, psf.tif, camera.json and preview.png."""
    recipe: Path | None = None
    """TOML file with options of this command; those on the command line go before."""
    sensitivity: bool = False
    """Say how alike the PSFs of nearer, farther and off-axis points are. Takes several times as long."""
    gds: bool = False
    """Write mask.gds too: one layer a lithography mask."""
    stl: bool = False
    """Write mask.stl too: a closed body in um."""
    stl_every: int = 1
    """Take one sample of so many along each axis for the STL."""

    def write(self, name: str, mask: MaskDesign, setup: Setup) -> None:
        """Design, write, and say what came out."""
        from mwdn.optics.design import check_replaced, design_camera
        from mwdn.optics.mask_files import write_gds, write_stl

        check_replaced(self.out, gds=self.gds, stl=self.stl)
        designed = design_camera(name, mask, setup)
        designed.write(self.out, sensitive=self.sensitivity)
        if self.gds:
            write_gds(self.out / "mask.gds", designed.mask)
        if self.stl:
            write_stl(self.out / "mask.stl", designed.mask, every=self.stl_every)
        made = designed.report()["made"]
        light = ", ".join(f"{part:.1%}" for part in made["light_on_sensor"])
        field = " x ".join(f"{angle:.0f}" for angle in made["field_degrees"])
        console.print(
            f"PSF {made['psf_hash']}: {light} of the aperture's light, resolution {made['resolution_mrad']:.1f} mrad, "
            f"field {field} degrees. Use it: --psf {self.out / 'psf.tif'} --background 0",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )


Flat = Parameter(name="*")
"""Its fields are options of the command."""


@design.command
def contour(
    *,
    mask: Annotated[Contour, Flat] = Contour(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Contour phase mask: levels that concentrate light onto thin lines. The defaults are the paper's camera."""
    output.write("contour", mask, setup)


@design.command
def diffuser(
    *,
    mask: Annotated[Diffuser, Flat] = Diffuser(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Smooth random surface whose hills focus light into a net of caustics."""
    output.write("diffuser", mask, setup)


@design.command
def lenslets(
    *,
    mask: Annotated[Lenslets, Flat] = Lenslets(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Small lenses at random places: a cloud of dots."""
    output.write("lenslets", mask, setup)


@design.command
def zone(
    *,
    mask: Annotated[ZoneAperture, Flat] = ZoneAperture(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Fresnel zone aperture: rings, every other one open."""
    output.write("zone", mask, setup)


@design.command
def coded(
    *,
    mask: Annotated[CodedAperture, Flat] = CodedAperture(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Separable coded aperture: squares by a maximum-length sequence or a MURA."""
    output.write("coded", mask, setup)


@design.command
def pinholes(
    *,
    mask: Annotated[Pinholes, Flat] = Pinholes(),
    setup: Annotated[Setup, Flat] = Setup(),
    output: Output = Output(),
) -> None:
    """Pinholes at random places."""
    output.write("pinholes", mask, setup)
