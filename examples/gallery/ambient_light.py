"""What if the room's light falls on the sensor, too?

Light that has not passed the mask lies over the capture as a smooth glow. No scene explains it, so it must be
subtracted: by a frame of the room alone, or by an estimate from the capture itself.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 192  # pixels along each side

# %%
# A capture in a dark room, and one beside a window: bluish light, more of it on the right. It makes up a third of all
# light on the sensor.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
scene = dark_scene("astronaut", (SIZE, SIZE), 5 * SIZE // 8)
light = mwdn.convolve(scene, psf)
light = 0.6 * light / light.max()
slope = torch.linspace(0.4, 1.6, SIZE) * torch.tensor([0.7, 1.0, 1.3]).view(1, 3, 1, 1)
room = 0.5 * light.mean() * slope.expand_as(light)
generator = torch.Generator().manual_seed(0)
dark_room, with_room, room_alone = (
    mwdn.Sensor().expose(on_sensor, generator=generator) for on_sensor in (light, light + room, room)
)
print(f"{room.sum() / (light + room).sum():.0%} of the light is the room's")

# %%
# Four ways: `ambient` of a calibration is the frame of the room alone (`--ambient room.png`); `room_light` estimates
# an even light and a slope from the capture (`--room-light`).

given = mwdn.Calibration(psf)
frame = with_room[0].movedim(0, -1).numpy()
by_frame = mwdn.Calibration(psf, ambient=room_alone).correct(frame)
estimating = mwdn.Reconstructor("admm", given, device="cpu", room_light=True)
reconstruct = mwdn.Reconstructor("admm", given, device="cpu")
pictures = {
    "dark room": reconstruct(dark_room),
    "left as it is": reconstruct(with_room),
    "room's frame subtracted": reconstruct(by_frame),
    "estimated": estimating(with_room),
}
share = estimating.without_room_light(with_room)[1]
print(f"estimated from the capture: {share.item():.0%}")
gain = light.sum() / mwdn.convolve(scene, psf).sum()
pictures = {name: (picture / gain).clamp(0, 1) for name, picture in pictures.items()}
for name, picture in pictures.items():
    print(f"{name}: {mwdn.psnr(picture, scene).item():.1f} dB")

# %%
# Above, the captures as they are reconstructed; below, the pictures. The frame of the room must have the exposure of
# the capture. The estimate needs no frame, and leaves a faint veil. What remains in both is the shot noise of the room.

figure, axes = plt.subplots(2, 4, figsize=(7.5, 4.1), layout="constrained")
used = dark_room, with_room, by_frame, estimating.without_room_light(with_room)[0]
for column, (title, picture), capture in zip(axes.T, pictures.items(), used, strict=True):
    for axis, image in zip(column, (capture / dark_room.max(), picture), strict=True):
        axis.imshow(srgb_encode(image.clamp(0, 1))[0].movedim(0, -1).numpy())
        axis.axis("off")
    column[0].set_title(title, fontsize=9)
