"""What does the sensor's crop cost?

The pattern of a point near the edge of the scene falls partly beside the sensor. A wider sensor would catch it.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side

# %%
# A photograph that fills the field of view, recorded twice: by a sensor of its size, which crops, and by one of twice
# its size, which catches all light.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
scene = dark_scene("astronaut", (SIZE, SIZE), SIZE)
wide = (2 * SIZE, 2 * SIZE)
cropped = mwdn.convolve(scene, psf)
whole = mwdn.convolve(scene, psf, size=wide)
print(f"light on the small sensor: {cropped.sum() / whole.sum():.0%} of all")

exposure = 0.9 / whole.max()
generator = torch.Generator().manual_seed(0)
cropped, whole = (mwdn.Sensor().expose(exposure * light, generator=generator) for light in (cropped, whole))

# %%
# ADMM reconstructs both. The PSF of the wide sensor is the same, in a dark frame.

margin = SIZE // 2
wide_psf = torch.nn.functional.pad(psf, (margin,) * 4)
admm = mwdn.solvers.Admm()
pictures = {
    "cropped": admm(cropped, psf) / exposure,
    "whole": (admm(whole, wide_psf) / exposure)[..., margin:-margin, margin:-margin],
}

# %%
# PSNR in the middle half of the picture, and in a frame around it that is an eighth of the side wide.

middle = slice(SIZE // 4, -(SIZE // 4))
frame = torch.ones(SIZE, SIZE, dtype=torch.bool)
frame[SIZE // 8 : -(SIZE // 8), SIZE // 8 : -(SIZE // 8)] = False
for name, picture in pictures.items():
    error = (picture.clamp(0, 1) - scene).square()
    centre, border = (-10 * part.mean().log10() for part in (error[..., middle, middle], error[..., frame]))
    print(f"{name}: {centre:.1f} dB in the middle, {border:.1f} dB at the border")

# %%
# The border loses most. The middle loses less: its patterns are almost complete on both sensors.

figure, axes = plt.subplots(1, 3, figsize=(7.5, 2.8), layout="constrained")
for axis, (title, picture) in zip(axes, {"scene": scene, **pictures}.items(), strict=True):
    axis.imshow(srgb_encode(picture.clamp(0, 1))[0].movedim(0, -1).numpy())
    axis.set_title(title)
    axis.axis("off")
