"""How do I notice a wrong PSF?

A wrong PSF gives a wrong picture. `mwdn reconstruct` images the picture through the PSF again and compares it with the
capture, and fits the PSF's mirror images and turns, too.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.diagnosis.trust import examine_picture
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side

# %%
# One capture.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
scene = dark_scene("astronaut", (SIZE, SIZE), 5 * SIZE // 8)
light = mwdn.convolve(scene, psf)
capture = mwdn.Sensor().expose(0.9 * light / light.max(), generator=torch.Generator().manual_seed(0))

# %%
# Three PSFs: the right one, the same mirrored, and that of another camera.

psfs = {
    "right": psf,
    "mirrored": psf.flip(-1),
    "another camera": unit_sum(sample_camera(5, (SIZE, SIZE))),
}

# %%
# For each the picture, and what the check says.

pictures = {}
for name, used in psfs.items():
    picture = mwdn.Reconstructor("pyramid", mwdn.Calibration(used), device="cpu")(capture)
    trust = examine_picture(capture, used, picture)
    pictures[name] = picture
    print(f"{name}: {trust.sentence}")
    for verdict in trust.verdicts:
        print(f"    {verdict.subject}, {verdict.state}: {verdict.text} {verdict.options}".rstrip())

# %%
# The mirrored PSF is recognised, with the option to use. For another camera's PSF no orientation fits better than the
# others.

figure, axes = plt.subplots(1, 3, figsize=(7.5, 2.8), layout="constrained")
for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(srgb_encode(mwdn.to_display(picture))[0].movedim(0, -1).numpy())
    axis.set_title(title)
    axis.axis("off")
