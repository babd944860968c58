"""How little light is enough?

A capture spreads each point of the scene over many pixels. In poor light their noise decides which method can still
reconstruct the scene.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side
ELECTRONS = (50, 200, 1_000, 5_000, 20_000)  # of the brightest pixel

# %%
# One camera, one scene, five amounts of light. The noise of a pixel with n electrons is the square root
# of n (shot noise), and three electrons of read noise.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
scene = dark_scene("coffee", (SIZE, SIZE), 5 * SIZE // 8)
light = mwdn.convolve(scene, psf)
exposure = 0.9 / light.max()
captures = {
    electrons: mwdn.Sensor(full_well=electrons / 0.9).expose(
        exposure * light, generator=torch.Generator().manual_seed(0)
    )
    for electrons in ELECTRONS
}

# %%
# Three methods with their defaults. All estimate the noise from the capture.

methods = ("wiener", "admm", "universal-small")
pictures, curves = {}, {}
for method in methods:
    reconstruct = mwdn.Reconstructor(method, mwdn.Calibration(psf), device="cpu")
    for electrons, capture in captures.items():
        pictures[method, electrons] = (reconstruct(capture) / exposure).clamp(0, 1)
    curves[method] = [mwdn.psnr(pictures[method, electrons], scene).item() for electrons in ELECTRONS]
    print(f"{method}: " + ", ".join(f"{score:.1f} dB" for score in curves[method]))

# %%
# At 50 electrons only the network still shows the cup, with few details. From 1,000 on, light matters less than the
# method: Wiener is limited by the sensor's crop, not by noise.

figure, axes = plt.subplot_mosaic(
    [["curve"] * 4, *([f"{electrons} {name}" for name in ("capture", *methods)] for electrons in (50, 1_000))],
    figsize=(7.5, 6.4),
    height_ratios=(1.3, 1, 1),
    layout="constrained",
)
for method, scores in curves.items():
    axes["curve"].semilogx(ELECTRONS, scores, "o-", label=method)
axes["curve"].set(xlabel="electrons of the brightest pixel", ylabel="PSNR / dB")
axes["curve"].grid(alpha=0.3)
axes["curve"].legend()
for electrons in (50, 1_000):
    shown = {"capture": captures[electrons]} | {method: pictures[method, electrons] for method in methods}
    for name, picture in shown.items():
        axis = axes[f"{electrons} {name}"]
        axis.imshow(srgb_encode(picture.clamp(0, 1))[0].movedim(0, -1).numpy())
        axis.set_title(f"{name}, {electrons:,}", fontsize=9)
        axis.axis("off")
