"""The displacement of the aperture's shadow that `align` finds in real captures, and how much more it explains.

    python benchmarks/envelope.py ../shared/data [--out benchmarks/results/envelope.json]

`universal` reconstructs each capture with the pose found, and with the same pose without the displacement. Explained is
the part of the capture's detail that the picture reproduces (`mwdn.evaluation.consistency`). Four minutes on two cores.
"""

import argparse
from pathlib import Path

import torch

import mwdn
from mwdn import Calibration, Reconstructor
from mwdn.evaluation.consistency import consistency
from mwdn.io.files import write_json
from mwdn.solvers import align
from universal import camera

LARGE = "mwdn-camera/psf_480.tif"
CAPTURES = {
    "mwdn-camera/real-objects/object_*.png": "mwdn-camera 320x320",
    "mwdn-camera/real-objects/scene*.png": LARGE,
    "mwdn-camera/display_capture.tif": LARGE,
    "diffusercam-tutorial/rawdata_hand_sample.tif": "DiffuserCam tutorial 300x400",
    "diffusercam/diffuser_images/*.npy": "DiffuserCam 270x480",
}
"""The PSF of each capture: of benchmarks/universal.py, or a file."""


@torch.no_grad()
def measured(reconstruct, capture):
    """Displacement in pixels, down and right, and the part explained without and with it."""
    calibration = reconstruct.calibration
    measurement = reconstruct.without_room_light(calibration.correct(calibration.frames.read(capture)))[0]
    pose = align(measurement, calibration.psf)
    explained = []
    for each in (pose._replace(envelope=None), pose):
        scene = reconstruct.at(each)(measurement)
        explained.append(round(consistency(measurement, calibration.psf, scene, pose=each).explained, 4))
    side = min(measurement.shape[-2:])
    return [round(float(part) * side, 1) for part in pose.envelope[0]], *explained


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/envelope.json"))
    arguments = parser.parse_args()
    mwdn.keep_memory()
    record = {}
    print("| capture | down, right / px | explained without | with |\n| --- | --- | --- | --- |")
    for pattern, psf in CAPTURES.items():
        calibration = Calibration.from_file(arguments.data / psf) if psf == LARGE else camera(arguments.data, psf)
        reconstruct = Reconstructor("universal", calibration)
        for capture in sorted(arguments.data.glob(pattern)):
            (down, right), without, explained = measured(reconstruct, capture)
            record[capture.stem] = {"shift_px": [down, right], "without": without, "with": explained}
            print(f"| {capture.stem} | {down:+.1f}, {right:+.1f} | {without:.3f} | {explained:.3f} |", flush=True)
    write_json(arguments.out, record)


if __name__ == "__main__":
    main()
