"""Train a small network for a simulated camera, and draw what it did with a capture.

python docs/interpret.py PHOTOGRAPHS mwdn-cpsf docs/interpret-mwdn-cpsf.jpg
"""

import sys
import tempfile
from pathlib import Path

import cv2

from mwdn.calibration import Calibration
from mwdn.data.random import seeded
from mwdn.inference.interpretation import interpret
from mwdn.inference.interpretation_page import SHEET, write_interpretation
from mwdn.inference.methods import find_method
from mwdn.io.pictures import dark_scene
from mwdn.optics import Camera, Sensor, Variety, sample_camera
from mwdn.training.experiment import train
from mwdn.training.recipe import Recipe, Schedule
from mwdn.weights.bundled import BUNDLED

SIZE = (160, 160)
SCHEDULE = Schedule(
    steps=140, batch=2, learning_rate=3e-3, filter_rate=10.0, validate_every=70, validation=4, ema=0.95, bfloat16=False
)


def main(photos: Path, name: str, out: Path) -> None:
    """Train ``name``, unless it is a bundled network, and write its sheet as JPEG."""
    variety = Variety(support=(0.5, 0.7), glow=(0.0, 0.05), halo=(0.0, 0.05), background=(0.0, 0.0))
    calibration = Calibration(sample_camera(3, SIZE, family="contours", variety=variety))
    light = Camera(calibration.psf).forward(dark_scene("astronaut", SIZE, side=100))
    measurement = Sensor().expose(light * (0.8 / light.max()), generator=seeded(0))
    with tempfile.TemporaryDirectory() as folder:
        checkpoint: str | Path = name
        if name not in BUNDLED:
            recipe = Recipe({"name": name, "width": 8}, SCHEDULE)
            checkpoint = train(recipe, calibration, photos=photos, out=Path(folder) / "run", callback=print)
        result = interpret(find_method(checkpoint), measurement, calibration.psf)
        print(result.content())
        write_interpretation(Path(folder) / "sheet", result)
        cv2.imwrite(str(out), cv2.imread(str(Path(folder) / "sheet" / SHEET)), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
