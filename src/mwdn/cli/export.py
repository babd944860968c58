"""`mwdn export`: write a method and its camera as a file for other programs."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.cli.camera import CameraOptions
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.terminal import say
from mwdn.export.exporter import MIN_AGREEMENT, Precision


def export(
    method: str,
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera.onnx"),
    precision: Precision = "float32",
    channels: int | None = None,
    least: float | None = None,
    **options: MethodOptions,
) -> None:
    """Write a method for one camera as a file for other programs: ONNX, or torch's .pt2.

    The file is run on simulated captures and is kept only if its results agree with mwdn's.

    Options of a solver: --regularisation 1e-4, --iterations 50 ...; `mwdn methods admm` lists those of admm.

    Args:
        method: as for `mwdn reconstruct --method`. The file does not align the PSF to each capture.
        camera: its calibration; the file is for this PSF and this picture size only.
        out: ends in .onnx or .pt2; an existing file is replaced only on success.
        precision: of the convolutions; float16 and int8 (ONNX only) make the file smaller.
        channels: of the captures, 1 or 3; those of the PSF unless given.
        least: PSNR in dB against mwdn's result that the file must reach; 80 for float32, 50 for float16 and 30 for
            int8 unless given.
        **options: options of the method.
    """
    from mwdn.export import exporter as exporting

    method_options = read_options([method], options, export)[method]
    exported = exporting.export(
        method, camera.load(), out, precision=precision, channels=channels, least=least, **method_options
    )
    required = MIN_AGREEMENT[precision] if least is None else least
    size = out.stat().st_size / 1e6
    line = f"{out} ({size:.1f} MB) agrees to {exported.agreement:.1f} dB (at least {required:.0f})"
    say(line)
    if "alignment" in exported.about:
        say(f"Alignment {exported.about['alignment']}.")
