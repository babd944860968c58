"""`mwdn export`: a reconstruction as a file for other programs."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.cli.camera import CameraOptions, console
from mwdn.export.exporter import LEAST, Precision


def export(
    method: str,
    *,
    camera: CameraOptions,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("camera.onnx"),
    precision: Precision = "float32",
    channels: int | None = None,
    regularisation: float | None = None,
    least: float | None = None,
) -> None:
    """Write a method bound to one camera as a file for other programs: ONNX, or torch's .pt2.

    The file is run on a simulated capture, and kept only if it gives what mwdn gives.

    Args:
        method: as for `mwdn reconstruct --method`. The PSF is taken as it is, not aligned to each capture.
        camera: its calibration; the file is for its PSF and its picture size alone.
        out: ends in .onnx or .pt2; one that exists is replaced when all has gone well.
        precision: of the convolutions; float16 and int8 (ONNX alone) make the file smaller.
        channels: 1 or 3, of the captures; those of the PSF unless given.
        regularisation: tau of admm or lambda of wiener.
        least: agreement with mwdn's own result, in dB, that the file must reach; 80 for float32, 50 for float16 and 30
            for int8 unless given.
    """
    from mwdn.export import exporter as exporting

    done = exporting.export(
        method,
        camera.load(),
        out,
        precision=precision,
        channels=channels,
        regularisation=regularisation,
        least=least,
    )
    bar = LEAST[precision] if least is None else least
    said = f"{out} ({out.stat().st_size / 1e6:.1f} MB) agrees to {done.agreement:.1f} dB (at least {bar:.0f})"
    console.print(said, highlight=False, markup=False, soft_wrap=True)
    if "alignment" in done.about:
        console.print(f"Alignment {done.about['alignment']}.", highlight=False, markup=False, soft_wrap=True)
