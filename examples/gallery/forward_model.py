"""What does a lensless camera record?

Each point of the scene casts the PSF of the camera, displaced. The sensor records the sum.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side

# %%
# A random camera, and three scenes: one point, two points of different brightness, and a photograph.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
camera = mwdn.Camera(psf)

point, two = torch.zeros(1, 3, SIZE, SIZE), torch.zeros(1, 3, SIZE, SIZE)
point[..., SIZE // 2, SIZE // 2] = 1
two[..., SIZE // 2, SIZE // 3] = 1
two[..., SIZE // 4, SIZE // 2] = 0.5
photograph = dark_scene("cat", (SIZE, SIZE), 5 * SIZE // 8)

# %%
# A point in the centre gives the PSF itself. The camera is linear: the capture of two points is the sum of two
# displaced PSFs, and a scene twice as bright gives a capture twice as bright.

captures = [camera(scene) for scene in (point, two, photograph)]
print(f"a point gives the PSF, up to {(captures[0] - psf).abs().max() / psf.max():.0e} of its peak")

displaced = psf.roll(SIZE // 3 - SIZE // 2, -1), psf.roll(SIZE // 4 - SIZE // 2, -2)
inside = slice(SIZE // 4, SIZE // 2)  # here no displaced PSF has wrapped around
error = (captures[1] - displaced[0] - 0.5 * displaced[1])[..., inside, inside].abs().max()
print(f"two points give the sum of two PSFs, up to {error / psf.max():.0e} of its peak")

# %%
# `camera.adjoint` correlates with the PSF: <A x, y> = <x, A* y> for all x and y. Every solver is made of these two.

y = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
left, right = (camera(photograph) * y).sum(), (photograph * camera.adjoint(y)).sum()
print(f"<A x, y> = {left:.4f}, <x, A* y> = {right:.4f}")

# %%
# The scenes above, their captures below.

figure, axes = plt.subplots(2, 3, figsize=(7.5, 5.2), layout="constrained")
titles = "one point", "two points", "a photograph"
for column, (title, scene, capture) in enumerate(zip(titles, (point, two, photograph), captures, strict=True)):
    for axis, picture in zip(axes[:, column], (scene, capture), strict=True):
        axis.imshow(srgb_encode(picture / picture.max())[0].movedim(0, -1).numpy())
        axis.axis("off")
    axes[0, column].set_title(title)
