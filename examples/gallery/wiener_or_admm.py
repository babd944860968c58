"""Wiener or ADMM?

The Wiener filter is one division in the Fourier domain. ADMM models what the sensor crops, and knows that light is not
negative. How much is that worth?
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side

# %%
# One camera, one photograph, two amounts of light: 15,000 and 500 electrons at the brightest pixel.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
scene = dark_scene("coffee", (SIZE, SIZE), 5 * SIZE // 8)
light = mwdn.convolve(scene, psf)
exposure = 0.9 / light.max()

captures = {
    f"{electrons:,} electrons": mwdn.Sensor(full_well=electrons).expose(
        exposure * light, generator=torch.Generator().manual_seed(0)
    )
    for electrons in (15_000, 500)
}

# %%
# Both methods with their defaults: Wiener chooses lambda from the noise, ADMM runs 100 iterations.

pictures = {}
for name, method in (("Wiener", mwdn.solvers.Wiener()), ("ADMM", mwdn.solvers.Admm())):
    for amount, capture in captures.items():
        picture = (method(capture, psf) / exposure).clamp(0, 1)
        pictures[name, amount] = picture
        print(f"{name}, {amount}: {mwdn.psnr(picture, scene).item():.1f} dB")

# %%
# Wiener leaves waves around the object: the division lacks what the sensor's crop has cut off. With more noise it
# chooses a larger lambda, and detail fades. ADMM keeps the dark dark.

figure, axes = plt.subplots(2, 3, figsize=(7.5, 5.2), layout="constrained")
for row, amount in enumerate(captures):
    shown = {"scene": scene, **{name: pictures[name, amount] for name in ("Wiener", "ADMM")}}
    for axis, (title, picture) in zip(axes[row], shown.items(), strict=True):
        axis.imshow(srgb_encode(picture)[0].movedim(0, -1).numpy())
        axis.set_title(title if title == "scene" else f"{title}, {amount}", fontsize=10)
        axis.axis("off")
