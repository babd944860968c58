"""`mwdn interpret`: draw what a network did to reconstruct a capture."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from torch.nn import Module

from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.terminal import Json, counted, print_json, say, warn
from mwdn.diagnosis.captures import refuse_dark
from mwdn.inference.interpretation import interpret as interpret_capture
from mwdn.inference.interpretation_page import JSON, SHEET, write_interpretation
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder, refuse_foreign, refuse_overwrite


@no_empty_folder
def interpret(
    method: str,
    capture: Path,
    *,
    camera: CameraOptions = CameraOptions(),
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/interpret"),
    device: str | None = None,
    json: Json = False,
) -> None:
    """Draw what a network did with a capture: PSFs, w and lambda, estimates at each scale, what each filter adds.

    Args:
        method: path of a checkpoint of mwdn, mwdn-cpsf, wiener, wiener-unet or wiener-bank; or universal,
            universal-small.
        capture: raw frame of the camera.
        camera: its calibration.
        out: folder for interpretation.png, interpretation.json, and each picture in pictures/.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        json: print the content of interpretation.json.
    """
    calibration = replace(camera.load(), white_balance=None)
    reconstruct = Reconstructor(method, calibration, device=device)
    warn(reconstruct.warning)
    refuse_overwrite(out / SHEET, capture, *camera.files)
    refuse_foreign(out, (JSON, SHEET), b'"parts"')
    measurement = calibration.correct(calibration.frames.read(capture)).to(reconstruct.device)
    refuse_dark(measurement)
    measurement, share = reconstruct.without_room_light(measurement)
    network = reconstruct.method
    result = interpret_capture(
        network.to(reconstruct.device) if isinstance(network, Module) else network, measurement, reconstruct.psf
    )
    check_folder(out)
    about: dict[str, object] = {"capture": str(capture), "method": method, "psf_hash": calibration.psf_hash}
    about["room_light"] = None if share is None else round(float(share), 4)
    paths = write_interpretation(out, result, **about)
    if json:
        print_json({**about, **result.content()})
    say(f"{counted(len(paths) - 2, 'picture')} in {out / 'pictures'}. Look at {out / SHEET}")
