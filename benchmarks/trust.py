"""Verdicts with right and wrong PSFs, on real captures of two cameras.

    python benchmarks/trust.py ../shared/data [--method universal] [--count 2]
    python benchmarks/trust.py ../shared/data --count 3 --saturated 0 0.2 0.4

Wrong PSFs: mirrored, rotated by 180, 90 and 3 degrees, displaced, and that of another camera. Prints one line each: the
fraction of the capture's detail that is reproduced, over the fraction that is not noise; the contrast with mirrored and
rotated PSFs; the verdict on the PSF: its state, and the turn that rights it. Then the ranges for each kind of PSF.

Second form: the right PSF only, and captures whose brightest parts are cut off. Which orientation fits best, and by how
much, without the limit `mwdn.diagnosis.orientation.MAX_SATURATED`.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch

from mwdn import Calibration, Reconstructor
from mwdn.diagnosis.orientation import fit_orientations
from mwdn.diagnosis.trust import examine_picture
from mwdn.io.files import atomic
from mwdn.optics import sample_camera
from mwdn.solvers.pose import Pose


def wrong(psf):
    size = (psf.shape[-2], psf.shape[-1])
    variants = {
        "right": psf,
        "mirrored left to right": psf.flip(-1),
        "mirrored top to bottom": psf.flip(-2),
        "turned by 180 degrees": psf.flip(-1, -2),
        "turned by 3 degrees": Pose(torch.tensor([3.0]), torch.zeros(1)).move(psf),
        "displaced by 16 pixels": torch.roll(psf, 16, -2),
        "displaced by a fifth of the frame": torch.roll(psf, (size[0] // 5, size[1] // 5), (-2, -1)),
        "another camera's": sample_camera(torch.Generator().manual_seed(3), size, family="contours").expand_as(psf),
    }
    if size[0] == size[1]:
        variants["turned by 90 degrees"] = torch.rot90(psf, 1, (-2, -1)).contiguous()
    return variants


def ranges(rows):
    """Lines of a table: for each kind of PSF the number of captures with each verdict, and the ranges of the scores."""
    yield "| PSF | captures | good | doubt | unknown | named | explained / possible | contrast |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for name in dict.fromkeys(row["psf"] for row in rows):
        those = [row for row in rows if row["psf"] == name]
        shares = [row["explained"] / row["possible"] for row in those]
        contrasts = [row["contrast"] for row in those]
        states = [row["state"] for row in those]
        counts = " | ".join(str(states.count(state)) for state in ("good", "doubt", "unknown"))
        named = ", ".join(dict.fromkeys(row["value"] for row in those if row["value"]))
        numbers = (f"{min(each):.2f} to {max(each):.2f}" for each in (shares, contrasts))
        yield f"| {name} | {len(those)} | {counts} | {named} | {' | '.join(numbers)} |"


def clipped(sets, count, parts):
    """Lines of a table: the lead of the orientation that fits best, for each capture and saturated part."""
    yield f"| capture | {' | '.join(f'{part:.0%}' for part in parts)} |"
    yield "| --- " * (1 + len(parts)) + "|"
    for calibration, captures in sets:
        for capture in captures[:count]:
            measurement = calibration.correct(calibration.frames.read(capture))
            limits = (float(measurement.flatten().quantile(1 - part)) for part in parts)
            fits = [fit_orientations(measurement.clamp(max=limit), calibration.psf) for limit in limits]
            yield f"| {capture.stem} | {' | '.join(f'{fit.lead:.2f} {fit.best}'.strip() for fit in fits)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--method", default="universal")
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--saturated", type=float, nargs="+", help="parts of the pixels that are cut off")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/trust.json"))
    arguments = parser.parse_args()
    camera, diffusercam = arguments.data / "mwdn-camera", arguments.data / "diffusercam"
    recovered = Calibration.from_file(
        diffusercam / "psf_recovered_270x480.npy", background=0.0, upside_down=True, bgr=True
    )
    sets = [
        (Calibration.from_file(camera / "psf_320.png"), sorted((camera / "real-objects").glob("object_*"))),
        (Calibration.from_file(camera / "psf_480.tif"), sorted((camera / "real-objects").glob("scene*"))),
        (recovered, sorted((diffusercam / "diffuser_images").glob("*.npy"))),
    ]
    if arguments.saturated:
        for line in clipped(sets, arguments.count, arguments.saturated):
            print(line, flush=True)
        return
    rows = []
    print("| capture | PSF | explained / possible | contrast | PSF |\n| --- | --- | --- | --- | --- |")
    for calibration, captures in sets:
        variants = wrong(calibration.psf)
        for capture in captures[: arguments.count]:
            measurement = calibration.correct(calibration.frames.read(capture))
            for name, psf in variants.items():
                scene = Reconstructor(arguments.method, replace(calibration, psf=psf))(measurement)
                trust = examine_picture(measurement, psf, scene)
                verdict, content = trust.orientation.verdict, trust.content
                found = {"state": verdict.state, "value": verdict.value}
                rows.append({"capture": capture.name, "psf": name, **found, **content})
                share = content["explained"] / content["possible"]
                line = f"| {capture.stem} | {name} | {share:.2f} | {content['contrast']:.2f} |"
                print(line, verdict.state, verdict.value, "|", flush=True)
    with atomic(arguments.out) as temporary:
        temporary.write_text(json.dumps({"method": arguments.method, "rows": rows}, indent=1) + "\n")
    print("", *ranges(rows), sep="\n")


if __name__ == "__main__":
    main()
