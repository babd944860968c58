"""Can a network reconstruct a camera that it was not trained for?

`universal` takes the PSF as an input. It was trained on random cameras, none of them the ones below. ADMM needs no
training at all.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side
CAMERAS = (11, 23)  # seeds of the random cameras

# %%
# Each camera records the same photograph in poor light: 2,000 electrons at the brightest pixel.

scene = dark_scene("cat", (SIZE, SIZE), 5 * SIZE // 8)
rows = []
for seed in CAMERAS:
    psf = unit_sum(sample_camera(seed, (SIZE, SIZE)))
    light = mwdn.convolve(scene, psf)
    exposure = 0.9 / light.max()
    capture = mwdn.Sensor(full_well=2000).expose(exposure * light, generator=torch.Generator().manual_seed(seed))
    calibration = mwdn.Calibration(psf)
    row = {"PSF": mwdn.to_display(psf)}
    for method in ("admm", "universal"):
        picture = (mwdn.Reconstructor(method, calibration, device="cpu")(capture) / exposure).clamp(0, 1)
        row[method] = picture
        print(f"camera {seed}, {method}: {mwdn.psnr(picture, scene).item():.1f} dB")
    rows.append(row)

# %%
# The PSFs, and the pictures.

figure, axes = plt.subplots(len(rows), 3, figsize=(7.5, 2.6 * len(rows)), layout="constrained")
for row, line in zip(rows, axes, strict=True):
    for axis, (title, picture) in zip(line, row.items(), strict=True):
        axis.imshow(srgb_encode(picture)[0].movedim(0, -1).numpy())
        axis.set_title(title, fontsize=10)
        axis.axis("off")
