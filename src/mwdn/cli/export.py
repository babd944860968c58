"""`mwdn export`: write a method and its camera as a file for other programs, or as a page for browsers."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.progress import show_progress
from mwdn.cli.terminal import say
from mwdn.errors import ParameterError
from mwdn.export.exporter import Exported, Precision, required_agreement
from mwdn.io.files import check_folder, refuse_overwrite


def export(  # noqa: PLR0913
    method: str = "universal-small",
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"])] = None,
    precision: Precision = "float32",
    channels: int | None = None,
    least: float | None = None,
    web: Path | None = None,
    runtime: Path | None = None,
    **options: MethodOptions,
) -> None:
    """Write a method for one camera as a file (ONNX, torch's .pt2, bioimage.io) or as a page (--web).

    The file is run on simulated captures and is kept only if its results agree with mwdn's.

    A page reconstructs captures in its visitor's browser, without a server: `mwdn export --web camera.toml -o site`.

    Options of a solver: --regularisation 1e-4, --iterations 50 ...; `mwdn methods admm` lists those of admm.

    Args:
        method: as for `mwdn reconstruct --method`, a network for a page. The exported file and the page do not align
            the PSF.
        camera: its calibration; the file is for this PSF and this picture size only, a page for any PSF of this size.
        out: ends in .onnx, .pt2, or .zip (the ONNX as a package of bioimage.io), camera.onnx unless given; an existing
            file is replaced only on success. A folder for --web, `site` unless given.
        precision: of the convolutions; float16 and int8 (ONNX only) make the file smaller.
        channels: of the captures, 1 or 3; those of the PSF unless given.
        least: PSNR in dB against mwdn's result that the file must reach; 80 for float32, 50 for float16 and 30 for
            int8 unless given.
        web: camera file or picture of a point source; write a folder with a page for this camera.
        runtime: folder of the npm package onnxruntime-web for --web; fetched by npm unless given.
        **options: options of the method.
    """
    method_options = read_options([method], options, export)[method]
    if web is None:
        if runtime is not None:
            raise ParameterError(f"`runtime` ({runtime}) is for pages. Add `--web CAMERA`, or leave it out.")
        out = out or Path("camera.onnx")
        check_folder(out.parent)
        refuse_overwrite(out, *camera.files, Path(method))
        write, calibration = _writer(out), camera.load()
        with show_progress() as progress:
            progress.start("Exporting, and comparing with mwdn", None)
            exported = write(
                method, calibration, out, precision=precision, channels=channels, least=least, **method_options
            )
        _report(exported, out.stat().st_size, required_agreement(least, precision))
        return
    if precision != "float32" or channels is not None:
        raise ParameterError("`precision` and `channels` are for files: a page computes in float32, grey and RGB.")
    _export_page(method, camera, out=out or Path("site"), web=web, runtime=runtime, least=least)


def _writer(out: Path) -> Callable[..., Exported]:
    """The function that writes a file of this suffix.

    Raises:
        ParameterError: none does.
    """
    if out.suffix not in (".onnx", ".pt2", ".zip"):
        raise ParameterError(f"`{out}` must end in .onnx, .pt2 or .zip, not '{out.suffix}'.")
    if out.suffix == ".zip":
        from mwdn.bridges.bioimage import export_bioimage

        return export_bioimage
    from mwdn.export import exporter

    return exporter.export


@no_empty_folder
def _export_page(
    method: str, camera: CameraOptions, *, out: Path, web: Path, runtime: Path | None, least: float | None
) -> None:
    from mwdn.export.site import SITE_FILES, export_site

    calibration = camera.load()
    with show_progress() as progress:
        progress.start("Exporting, and comparing with mwdn", None)
        exported = export_site(method, calibration, out, runtime=runtime, name=web.name, least=least)
    size = sum((out / name).stat().st_size for name in SITE_FILES)
    _report(exported, size, required_agreement(least))
    say(f"Open {out / SITE_FILES[0]}, or copy the folder to a static host.")


def _report(exported: Exported, size: int, required: float) -> None:
    say(f"{exported.path} ({size / 1e6:.1f} MB) agrees to {exported.agreement:.1f} dB (at least {required:.0f})")
    if "alignment" in exported.about:
        say(f"Alignment {exported.about['alignment']}.")
