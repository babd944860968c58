"""Light of the room over three scenes: as it is, estimated from the capture and subtracted, and a dark room.

python docs/room_light.py ../shared/data/mwdn-camera [docs/room-light.jpg]
"""

import sys
from pathlib import Path

import cv2
import torch

from mwdn import Calibration, Reconstructor, Sensor, convolve
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics.room_light import sloping_light, spot_light


def main(camera: Path, out: Path = Path("docs/room-light.jpg")) -> None:
    """Expose the scenes, reconstruct each capture and draw the sheet."""
    calibration = Calibration.from_file(camera / "psf_320.png")
    size = calibration.size
    rooms = {"narrow spot": 0.3 * spot_light(size, (0.4, 0.6), 0.15), "slope": 0.25 * sloping_light(size, 0.6)}
    cases = [("coffee", 320, "narrow spot"), ("astronaut", 160, "narrow spot"), ("cat", 160, "slope")]
    as_it_is, estimating = (Reconstructor("universal", calibration, room_light=on) for on in (False, True))
    sheet = []
    for name, side, room in cases:
        light = convolve(dark_scene(name, size, side), calibration.psf)
        both = light + rooms[room] * light.mean()
        exposure = 0.8 / both.max()
        generator = torch.Generator().manual_seed(0)
        capture, dark_room = (Sensor().expose(each * exposure, generator=generator) for each in (both, light))
        sheet.append([capture, as_it_is(capture), estimating(capture), as_it_is(dark_room)])
    titles = ["capture", "--no-room-light", "--room-light", "in a dark room"]
    drawing = srgb_encode(contact_sheet(sheet, titles, height=200))
    pixels = (drawing[0].flip(0).permute(1, 2, 0) * 255).round().byte().numpy()
    cv2.imwrite(str(out), pixels, [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    with torch.inference_mode():
        main(Path(sys.argv[1]), *map(Path, sys.argv[2:]))
