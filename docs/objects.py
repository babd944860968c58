"""Real objects of the paper's camera, reconstructed by ADMM, by the pyramid and by a trained network.

    python docs/objects.py ../shared/data/mwdn-camera runs/mine/best.safetensors [docs/objects.jpg]

The network was trained for `psf_320.png`; the larger captures are from the same mask, with `psf_480.tif`.
"""

import sys
from pathlib import Path

import cv2
import torch

from mwdn import Calibration, Reconstructor, read_frame, to_display
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode


def main(camera: Path, weights: str, out: Path = Path("docs/objects.jpg")) -> None:
    """Reconstruct all captures and draw the sheet."""
    rows = []
    for pattern, psf in (("object_*", "psf_320.png"), ("scene*", "psf_480.tif")):
        calibration = Calibration.from_file(camera / psf)
        methods = [Reconstructor(method, calibration) for method in ("admm", "pyramid", weights)]
        for capture in sorted((camera / "real-objects").glob(pattern)):
            measurement = calibration.correct(read_frame(capture))
            pictures = [to_display(method(measurement)) for method in methods]
            top = (pictures[0].shape[-1] - 200) // 2  # the objects are in the central 200 x 200 pixels
            rows.append([picture[..., top : top + 200, top : top + 200] for picture in pictures])
    # Two halves side by side: a page is wider than high.
    half = (len(rows) + 1) // 2
    pairs = [left + right for left, right in zip(rows[:half], rows[half:], strict=True)]
    sheet = srgb_encode(contact_sheet(pairs, 2 * ["ADMM", "pyramid", "network"], height=200))
    pixels = (sheet[0].flip(0).permute(1, 2, 0) * 255).round().byte().numpy()
    cv2.imwrite(str(out), pixels, [cv2.IMWRITE_JPEG_QUALITY, 75])


if __name__ == "__main__":
    with torch.inference_mode():
        main(Path(sys.argv[1]), sys.argv[2], *map(Path, sys.argv[3:]))
