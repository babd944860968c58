"""Real captures of cameras that the bundled network was not trained on, beside ADMM.

python docs/universal.py ../shared/data [docs/universal.jpg]
"""

import sys
from pathlib import Path

import cv2
import torch
from torch.nn import functional as F

from mwdn import Calibration, Reconstructor, to_display
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode

DIFFUSERCAM = {"background": 0.0, "upside_down": True, "bgr": True}


def rows(calibration: Calibration, captures: list[Path], *, middle: int = 0) -> list[list[torch.Tensor]]:
    """Pictures by ADMM and by the network, cropped to their central ``middle`` pixels unless 0."""
    methods = [Reconstructor(method, calibration) for method in ("admm", "universal")]
    sheet = []
    for capture in captures:
        measurement = calibration.correct(calibration.frames.read(capture))
        pictures = [to_display(method(measurement)) for method in methods]
        rows, columns = ((size - (middle or size)) // 2 for size in pictures[0].shape[-2:])
        sheet.append([p[..., rows : p.shape[-2] - rows, columns : p.shape[-1] - columns] for p in pictures])
    return sheet


def widened(column: list[list[torch.Tensor]]) -> list[list[torch.Tensor]]:
    """Pad a column's pictures with white to the shape of its widest one, so that they stand under their titles."""
    shape = max(pair[0].shape[-1] / pair[0].shape[-2] for pair in column)
    return [[F.pad(p, (0, round(p.shape[-2] * shape) - p.shape[-1]), value=1.0) for p in pair] for pair in column]


def main(data: Path, out: Path = Path("docs/universal.jpg")) -> None:
    """Reconstruct all captures and draw the sheet."""
    camera, diffusercam, tutorial = data / "mwdn-camera", data / "diffusercam", data / "diffusercam-tutorial"
    small = Calibration.from_file(camera / "psf_320.png")
    large = Calibration.from_file(camera / "psf_480.tif")
    pairs = [
        *rows(small, sorted((camera / "real-objects").glob("object_*")), middle=200),
        *rows(large, sorted((camera / "real-objects").glob("scene*")), middle=200),
        *rows(large, [camera / "display_capture.tif"], middle=240),
        *rows(Calibration.from_file(tutorial / "psf_sample.tif", bin=4), [tutorial / "rawdata_hand_sample.tif"]),
        *rows(
            Calibration.from_file(diffusercam / "psf_recovered_270x480.npy", **DIFFUSERCAM),
            sorted((diffusercam / "diffuser_images").glob("*.npy")),
        ),
    ]
    third = -(-len(pairs) // 3)
    pairs += [[torch.ones_like(p) for p in pairs[0]]] * (3 * third - len(pairs))
    columns = [widened(pairs[i : i + third]) for i in range(0, 3 * third, third)]
    lines = [a + b + c for a, b, c in zip(*columns, strict=True)]
    sheet = srgb_encode(contact_sheet(lines, 3 * ["ADMM", "universal"], height=180))
    pixels = (sheet[0].flip(0).permute(1, 2, 0) * 255).round().byte().numpy()
    cv2.imwrite(str(out), pixels, [cv2.IMWRITE_JPEG_QUALITY, 72])


if __name__ == "__main__":
    with torch.inference_mode():
        main(Path(sys.argv[1]), *map(Path, sys.argv[2:]))
