"""Reconstruct a capture with an exported file, using numpy, onnxruntime and OpenCV, without torch and mwdn.

mwdn export universal-small --psf psf.png --out camera.onnx
python examples/onnx_only.py camera.onnx capture.png scene.png [dark.png or ambient.png]
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime


def load(model):
    """Session and description of a file."""
    try:
        session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many kinds
        sys.exit(f"{model} cannot be opened: {str(error).splitlines()[0]}")
    about = session.get_modelmeta().custom_metadata_map
    if "psf_hash" not in about:
        sys.exit(f"{model} must be a file that `mwdn export` wrote.")
    if missing := {"flat", "hot_pixels", "stray_light", "sensor_field"} & about.keys():
        sys.exit(f"{model} needs corrections that this script does not make: {', '.join(sorted(missing))}.")
    return session, about


def read(path, about):
    """Read a frame as linear light, RGB, (H, W, C), rows as stored, 1 is saturation; and whether it is saturated."""
    try:
        frame = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):
        frame = None
    if frame is None or not np.isfinite(frame).all():
        sys.exit(f"{path} cannot be read as PNG, TIFF, JPEG or BMP of finite numbers.")
    largest = np.iinfo(frame.dtype).max if frame.dtype.kind in "iu" else 1
    full = 2 ** int(about["bit_depth"]) - 1 if "bit_depth" in about else largest
    if largest > 1 and not frame.max() <= full <= largest:
        sys.exit(f"{path} ({frame.dtype}, up to {frame.max()}) must hold numbers of {about['bit_depth']} bits.")
    if frame.ndim == 3 and frame.shape[2] == 4 and frame[..., 3].min() < largest:
        sys.exit(f"{path} is transparent in parts. Save it without transparency.")
    frame = frame[..., :3][..., ::-1] if frame.ndim == 3 else frame[..., None]  # OpenCV gives BGR
    # Sensors of 10, 12 or 14 bits may use the lower bits of 16.
    fills_bits = full == 65535 and "bit_depth" not in about and frame.max() in (1023, 4095, 16383)
    saturated = largest > 1 and (frame.max() > 0.98 * full or fills_bits)
    frame = (frame[..., ::-1] if "colours" in about else frame).astype(np.float32) / full
    return decoded(frame, about["gamma"]) if "gamma" in about else frame, saturated


def decoded(frame, gamma):
    """Decode sRGB or a power to linear light."""
    if gamma == "srgb":
        return np.where(frame <= 0.04045, frame / 12.92, ((frame + 0.055) / 1.055) ** np.float32(2.4))
    return frame.clip(min=0) ** np.float32(gamma)


def with_plateau(frame, corrected):
    """Saturated pixels, whose light is unknown, have one value in each colour again, the least of their maxima."""
    corrected = corrected.copy()
    for before, after in zip(np.moveaxis(frame, 2, 0), np.moveaxis(corrected, 2, 0), strict=True):
        low, high = np.float32([0.98, 0.995]) * before.max()
        above, at = ((before[:, ::2] >= least).mean() for least in (low, high))
        if not (at > above - at > 0 and at >= 5e-4):  # no plateau at the brightest value
            continue
        saturated, border = before >= high, cv2.BORDER_CONSTANT
        count = cv2.boxFilter(saturated.astype(np.float32), -1, (3, 3), normalize=False, borderType=border)
        known = saturated & (count > 1.5) & (after != before) & (after > before / 2)
        largest = cv2.dilate(np.where(known, after, -np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
        after[:] = np.minimum(after, largest[known].min(initial=np.inf))
    return corrected


def cropped(frame, height, width):
    """Crop to the middle part; (H // 2, W // 2) stays the centre."""
    top, left = (max(0, n // 2 - kept // 2) for n, kept in zip(frame.shape, (height, width), strict=False))
    return frame[top : top + height, left : left + width]


def binned(frame, factor):
    """Average blocks of pixels; the block at the centre becomes the centre."""
    for axis in (0, 1):
        length, blocks = frame.shape[axis], frame.shape[axis] // factor
        start = min(length // 2 - blocks // 2 * factor, length - blocks * factor)
        frame = frame.take(range(start, start + blocks * factor), axis)
    height, width, channels = frame.shape
    return frame.reshape(height // factor, factor, width // factor, factor, channels).mean((1, 3))


def demosaiced(frame, mosaic):
    """Turn 2 x 2 cells of a colour filter array into pixels; the two greens are averaged."""
    cells = [frame[row::2, column::2, 0] for row in (0, 1) for column in (0, 1)]
    colours = [[cell for cell, letter in zip(cells, mosaic, strict=True) if letter == colour] for colour in "rgb"]
    return np.stack([sum(each) / len(each) for each in colours], axis=-1)


def measured(capture, dark, about):
    """Input of the file: a capture minus its dark or ambient frame, cropped, binned, row 0 at the top, (1, C, H, W)."""
    frame, saturated = read(capture, about)
    if dark:
        level, _ = read(dark, about)
        if level.shape[:2] != frame.shape[:2] or level.shape[2] not in (1, frame.shape[2]):
            sys.exit(f"{dark} {level.shape} must have the size of {capture} {frame.shape}.")
        frame = with_plateau(frame, frame - level) if saturated else frame - level
    elif kind := {"dark", "ambient"} & about.keys():
        sys.exit(f"{capture} needs a {kind.pop()} frame, as this camera's calibration has one: name it last.")
    if "mosaic" in about:
        frame = demosaiced(frame, about["mosaic"])
    if "grey" in about:
        frame = frame.mean(2, keepdims=True)
    if "crop" in about:
        frame = cropped(frame, *map(int, about["crop"].split(" x ")))
    frame = binned(frame, int(about["binning"]))
    frame = frame[::-1] if "rows" in about else frame
    return np.ascontiguousarray(frame.transpose(2, 0, 1)[None])


def to_display(scene):
    """Scale so that all but the brightest 0.3 % fit into [0, 1], then encode as sRGB in 8 bits."""
    brightest = np.sort(scene, axis=None)[-1 - int(0.003 * scene.size)]
    light = np.clip(scene / max(brightest, 1e-12), 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * encoded).round().astype(np.uint8)


def main(model, capture, out, dark=None):
    session, about = load(model)
    measurement = measured(capture, dark, about)
    wanted = session.get_inputs()[0].shape[1:]
    if list(measurement.shape[1:]) != wanted:
        sys.exit(f"{capture} is {measurement.shape[1:]} (channels, height, width), but {model} takes {wanted}.")
    (scene,) = session.run(["scene"], {"measurement": measurement})
    picture = to_display(scene[0].transpose(1, 2, 0))
    try:
        cv2.imencode(Path(out).suffix, np.ascontiguousarray(picture[..., ::-1]))[1].tofile(out)
    except (OSError, cv2.error):
        sys.exit(f"{out} cannot be written: it must end in .png, .jpg or .tif, in a folder that exists.")
    print(f"{out}: {about['method']} for PSF {about['psf_hash']}, written by mwdn {about['version']}")


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        sys.exit(__doc__)
    main(*sys.argv[1:])
