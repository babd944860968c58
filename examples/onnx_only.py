"""Reconstruct a capture with an exported file: numpy, onnxruntime and OpenCV, neither torch nor mwdn.

mwdn export universal-small --psf psf.png --out camera.onnx
python examples/onnx_only.py camera.onnx capture.png scene.png [dark.png]
"""

import sys

import cv2
import numpy as np
import onnxruntime


def read(path, bit_depth):
    """A frame as linear light in RGB, (H, W, C); 1 is saturation."""
    frame = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    if frame is None:
        sys.exit(f"{path} cannot be read.")
    frame = frame[..., :3][..., ::-1] if frame.ndim == 3 else frame[..., None]
    return frame.astype(np.float32) / (2**bit_depth - 1 if bit_depth else np.iinfo(frame.dtype).max)


def for_people(scene):
    """Scale so that all but the brightest 0.3 % fit into [0, 1], then encode as sRGB in 8 bits."""
    light = np.clip(scene / max(np.quantile(scene, 0.997), 1e-12), 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * encoded).round().astype(np.uint8)


def main(model, capture, out, dark=None):
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    about = session.get_modelmeta().custom_metadata_map
    bit_depth = int(about.get("bit_depth", 0))
    frame = read(capture, bit_depth)
    if dark:
        frame = frame - read(dark, bit_depth)
    measurement = np.ascontiguousarray(frame.transpose(2, 0, 1)[None])
    wanted = session.get_inputs()[0].shape[1:]
    if list(measurement.shape[1:]) != wanted:
        sys.exit(f"{capture} is {measurement.shape[1:]} (channels, height, width), but {model} takes {wanted}.")
    (scene,) = session.run(["scene"], {"measurement": measurement})
    picture = for_people(scene[0].transpose(1, 2, 0))
    if not cv2.imwrite(out, np.ascontiguousarray(picture[..., ::-1])):
        sys.exit(f"{out} cannot be written.")
    print(f"{out}: {about['method']} for PSF {about['psf_hash']}, written by mwdn {about['version']}")


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        sys.exit(__doc__)
    main(*sys.argv[1:])
