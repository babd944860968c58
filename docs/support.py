"""Which parts of a picture its capture supports: with the right PSF, and with the PSF mirrored.

python docs/support.py ../shared/data/mwdn-camera [docs/support.jpg]
"""

import sys
from pathlib import Path

import cv2
import torch

from mwdn import Calibration, Reconstructor, read_frame, to_display
from mwdn.diagnosis.trust import examine_picture
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode
from mwdn.io.support_picture import support_picture


def main(camera: Path, out: Path = Path("docs/support.jpg")) -> None:
    """Reconstruct one capture through both PSFs and draw pictures and maps."""
    row = []
    for orientation in (None, "flip-left-right"):
        calibration = Calibration.from_file(camera / "psf_320.png", psf_orientation=orientation)
        measurement = calibration.correct(read_frame(camera / "real-objects" / "object_4.png"))
        scene = Reconstructor("universal", calibration)(measurement)
        trust = examine_picture(measurement, calibration.psf, scene)
        print(orientation, trust.sentence)
        drawing = support_picture(scene, trust.support.map)
        picture = torch.ones_like(drawing)
        picture[..., : scene.shape[-2], :] = to_display(scene)
        row += [picture, drawing]
    titles = ["right PSF", "its support", "mirrored PSF", "its support"]
    sheet = srgb_encode(contact_sheet([row], titles, height=row[0].shape[-2]))
    pixels = (sheet[0].flip(0).permute(1, 2, 0) * 255).round().byte().numpy()
    cv2.imwrite(str(out), pixels, [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    with torch.inference_mode():
        main(Path(sys.argv[1]), *map(Path, sys.argv[2:]))
