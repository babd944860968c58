"""Light of a room on the sensor: what it costs, and what --ambient and --room-light bring back.

    python benchmarks/ambient.py ../shared/data [--methods universal-small universal] [--psfs "mwdn-camera 320x320"]
                                              [--filling 2] [--dark 2] [--spots | --real]

Test photographs that fill the frame and objects on dark, 15,000 electrons at saturation, exact PSF. The light is a
share of the mean measurement: even 20 %, a slope of 0 to 50 %, Gaussian spots of 30 % with a standard deviation of 0.4
(wide) and 0.15 (narrow) of the frame's width. PSNR over the whole frame, clipped, means. Prints the table and writes
the numbers of each picture.

`ambient` subtracts a frame of the room's light alone, without its noise, as `mwdn.Calibration` does. Two rows say
what no method can recover. `exact` subtracts the light itself, so that only its photon noise remains. `dark room` has
no such light, but the exposure of the capture that has: a bright spot saturates earlier, so the scene gets less light.
`--spots` and `--real` reconstruct nothing. The first says which narrow spots are found, and with which error (root mean
square over the mean measurement). The second adds these lights to real captures, and says how much of them is found and
left: room light with the PSFs and the stray light of real cameras.
"""

import argparse
import itertools
import json
from pathlib import Path
from statistics import fmean

import torch
from torch.nn import functional as F

import mwdn
from known_captures import real_captures
from mwdn import Camera, Reconstructor, psnr
from mwdn.calibration.ambient_frame import denoise_ambient
from mwdn.data.photographs import Photographs
from mwdn.inference.room_light import find_room_light
from mwdn.optics.room_light import even_light, sloping_light, spot_light
from mwdn.optics.sensor import Sensor
from universal import PSFS, camera, keep

HANDLINGS = ("nothing", "room-light", "ambient", "exact", "dark room")


def lights(size):
    """Light (H, W) in units of the mean measurement."""
    return {
        "none": 0 * even_light(size),
        "even": 0.2 * even_light(size),
        "slope": 0.25 * sloping_light(size, 0.6),
        "wide spot": 0.3 * spot_light(size, (0.4, 0.6), 0.4),
        "narrow spot": 0.3 * spot_light(size, (0.4, 0.6), 0.15),
    }


def mixed_lights(size):
    """A plane of light and a wide spot together."""
    return {
        "even and wide": 0.12 * even_light(size) + 0.2 * spot_light(size, (0.3, 0.7), 0.4),
        "slope and wide": 0.15 * sloping_light(size, 0.6) + 0.15 * spot_light(size, (0.6, 0.3), 0.4),
    }


def scene(picture, size, *, fills):
    """A photograph (1, 3, side, side) over the whole frame, or at half its shorter side on dark."""
    height, width = size
    side = max(size) if fills else min(size) // 2
    picture = F.interpolate(picture, (side, side), mode="bilinear", antialias=True)
    if fills:
        top, left = (side - height) // 2, (side - width) // 2
        return picture[..., top : top + height, left : left + width]
    top, left = (height - side) // 2, (width - side) // 2
    return F.pad(picture, (left, width - side - left, top, height - side - top))


def scores(reconstructors, calibration, picture, *, fills):
    """PSNR by light and handling for one scene."""
    size, sensor, values = calibration.size, Sensor(full_well=15_000), {}
    truth = scene(picture, size, fills=fills)
    clean = Camera(calibration.psf.expand(-1, 3, -1, -1)).forward(truth)
    for name, shape in lights(size).items():
        room = shape * clean.mean()
        gain = 0.8 / float((clean + room).max())
        generator = torch.Generator().manual_seed(1)
        capture = sensor.expose((clean + room) * gain, generator=generator) / gain
        frame = sensor.expose((clean * 0 + room) * gain, generator=generator) / gain
        dark = sensor.expose(clean * gain, generator=generator) / gain
        known = capture - denoise_ambient(frame)
        measurements = dict(zip(HANDLINGS, (capture, capture, known, capture - room, dark), strict=True))
        values[name] = {
            handling: round(float(psnr(one(measurements[handling]).clamp(0, 1), truth)), 3)
            for handling, one in reconstructors.items()
        }
    return values


def spots(calibration, picture, *, fills):
    """Lines of a table: narrow spots of some shares of the mean measurement, what is found and its error."""
    clean = Camera(calibration.psf.expand(-1, 3, -1, -1)).forward(scene(picture, calibration.size, fills=fills))
    for share in (0.01, 0.02, 0.03, 0.05, 0.3):
        room = share * spot_light(calibration.size, (0.4, 0.6), 0.15) * clean.mean()
        gain = 0.8 / float((clean + room).max())
        capture = (
            Sensor(full_well=15_000).expose((clean + room) * gain, generator=torch.Generator().manual_seed(1)) / gain
        )
        found = find_room_light(capture, calibration.psf)
        error = ((found.background - room) / capture.mean((-2, -1), keepdim=True)).square().mean().sqrt()
        yield f"{'filling' if fills else 'dark'} | {share} | {float(found.share):.3f} | {float(error):.4f}"


def rms(light):
    return float(light.square().mean().sqrt())


def real(data):
    """Lines of a table: light added to each real capture, what is found and what is left, over the mean measurement."""
    for capture in real_captures(data):
        if capture.name.count(",") > 1 or capture.truth["bin"] != "1":
            continue  # the same capture in another state, or with another PSF
        calibration = capture.calibration("light")
        b = calibration.correct(capture.frame)
        for name, shape in (lights(calibration.size) | mixed_lights(calibration.size)).items():
            room = shape * b.mean()
            lit = b + room
            found = find_room_light(lit, calibration.psf)
            cells = rms(room / lit.mean()), float(found.share), rms((found.background - room) / lit.mean())
            yield f"{capture.name} | {name} | {' | '.join(f'{each:.3f}' for each in cells)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--methods", nargs="+", default=["admm", "pyramid", "universal-small", "universal"])
    parser.add_argument("--psfs", nargs="+", choices=PSFS, default=["mwdn-camera 320x320"])
    parser.add_argument("--filling", type=int, default=2)
    parser.add_argument("--dark", type=int, default=2)
    parser.add_argument("--spots", action="store_true")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ambient.json"))
    arguments = parser.parse_args()
    mwdn.keep_memory()
    if arguments.real:
        print("| capture | light | added | found | left |\n|" + " --- |" * 5)
        for line in real(arguments.data):
            print(f"| {line} |", flush=True)
        return
    photographs = Photographs(arguments.data / "photos" / "test", limit=arguments.filling + arguments.dark)
    if arguments.spots:
        print("| PSF | scene | spot | found | error |\n|" + " --- |" * 5)
        for name, number in itertools.product(arguments.psfs, range(arguments.filling + arguments.dark)):
            picture = photographs.light(torch.tensor([number]))
            for line in spots(camera(arguments.data, name), picture, fills=number < arguments.filling):
                print(f"| {name} | {line} |", flush=True)
        return
    rows = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    print("| PSF | method | scenes | handling |", " | ".join(lights((2, 2))), "|\n|" + " --- |" * 9)
    for name in arguments.psfs:
        calibration = camera(arguments.data, name)
        for method in arguments.methods:
            plain = Reconstructor(method, calibration, room_light=False)
            lit = Reconstructor(method, calibration, room_light=True)
            ways = dict(zip(HANDLINGS, (plain, lit, plain, plain, plain), strict=True))
            for kind, numbers in (
                ("filling", range(arguments.filling)),
                ("dark", range(arguments.filling, arguments.filling + arguments.dark)),
            ):
                pictures = [photographs.light(torch.tensor([n])) for n in numbers]
                values = [scores(ways, calibration, picture, fills=kind == "filling") for picture in pictures]
                row = {"psf": name, "method": method, "scenes": kind}
                rows = [old for old in rows if {key: old[key] for key in row} != row] + [row | {"values": values}]
                keep(rows, arguments.out)
                for way in HANDLINGS:
                    cells = [f"{fmean(value[light][way] for value in values):.2f}" for light in values[0]]
                    print(f"| {name} | {method} | {kind} | {way} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
