"""What is a mask worth?

One pinhole makes a picture without any computation, but lets little light through. Many pinholes let more light
through, and a phase mask nearly all of it; their captures need a reconstruction.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import Diffuser, Pinholes, Setup, mask_psf

SIZE = 192  # pixels along each side

# %%
# Three masks at the same place: 2 mm in front of a sensor with pixels of 9.6 um, behind the same aperture. Their PSFs
# come from diffraction at five wavelengths. The sum of each is the part of the aperture's light that reaches the
# sensor.

side_mm, hole_um = 0.005 * SIZE, 40 * SIZE / 192
setup = Setup(pixels=(4 * SIZE, 4 * SIZE), aperture_mm=(side_mm, side_mm), wavelengths=5)
masks = {
    "one pinhole": Pinholes(size_mm=(side_mm, side_mm), count=1, diameter_um=hole_um),
    "15 pinholes": Pinholes(size_mm=(side_mm, side_mm), count=15, diameter_um=hole_um),
    "diffuser": Diffuser(size_mm=(1.2 * side_mm, 1.2 * side_mm)),
}
psfs = {name: mask_psf(mask.build(setup), setup) for name, mask in masks.items()}

# %%
# The same scene in the same light, twice. First all masks have the same exposure time, that of the diffuser; then each
# has the time that it needs to bring its brightest pixel to 90 % of saturation.

scene = dark_scene("coffee", (SIZE, SIZE), SIZE // 2)
time = 0.9 / mwdn.convolve(scene, psfs["diffuser"]).max()
pictures, captures = {}, {}
for name, psf in psfs.items():
    light = mwdn.convolve(scene, psf)
    own = 0.9 / light.max()
    for row, exposure in (("same time", time), ("own time", own)):
        capture = mwdn.Sensor().expose(exposure * light, generator=torch.Generator().manual_seed(0))
        reconstruct = mwdn.Reconstructor("admm", mwdn.Calibration(psf), device="cpu")
        picture = (reconstruct(capture) / (exposure * psf.sum() / 3)).clamp(0, 1)
        pictures[row, name], captures[row, name] = picture, capture
        print(f"{name}, {row} ({exposure / time:.3g} x): {mwdn.psnr(picture, scene).item():.1f} dB")
    print(f"    {psf.sum() / 3:.1%} of the aperture's light reaches the sensor")

# %%
# In the same time, the pinhole's picture is grainy: its capture has a few hundredths of the electrons. With hundreds of
# times the exposure it is as sharp as the others. The diffuser is worth that time, for a scene that moves or is dark.

figure, axes = plt.subplots(3, 3, figsize=(7.5, 7.6), layout="constrained")
for column, name in zip(axes.T, masks, strict=True):
    shown = {f"{name}: PSF": psfs[name] / psfs[name].amax() * 2}
    shown |= {row: pictures[row, name] for row in ("same time", "own time")}
    for axis, (title, picture) in zip(column, shown.items(), strict=True):
        axis.imshow(srgb_encode(picture.clamp(0, 1))[0].movedim(0, -1).numpy())
        axis.set_title(title, fontsize=10)
        axis.axis("off")
