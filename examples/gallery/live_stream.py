"""How do I look through the camera live?

A live picture must not take a second. Frames of a video resemble each other, so ADMM can start each one from the
picture before, with a tenth of the iterations. What does that cost when the scene moves?
"""

import contextlib

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.io.images import srgb_encode
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum
from mwdn.runtime.streams import latest

SIZE = 192  # pixels along each side
FRAMES = 18  # of the video

# %%
# A video of a simulated camera: the cup stands still, then moves by a pixel from frame to frame; then the scene is cut
# to the cat, which does not move.

psf = unit_sum(sample_camera(11, (SIZE, SIZE)))
part = FRAMES // 3
cup, cat = (dark_scene(name, (SIZE, SIZE), SIZE // 2) for name in ("coffee", "cat"))
scenes = part * [cup] + [cup.roll(number + 1, -1) for number in range(part)] + part * [cat]
generator = torch.Generator().manual_seed(0)
exposure = 0.8 / max(mwdn.convolve(scene, psf).max() for scene in (cup, cat))
captures = [mwdn.Sensor().expose(exposure * mwdn.convolve(scene, psf), generator=generator) for scene in scenes]
frames = [capture[0].movedim(0, -1).numpy() for capture in captures]  # raw, as a camera delivers them

# %%
# `Reconstructor.stream` reconstructs frame after frame: 100 iterations for the first, 10 for each that follows. For
# comparison, each frame by itself: with 100 iterations, and with 10.

calibration = mwdn.Calibration(psf)
live = mwdn.Reconstructor("admm", calibration, device="cpu")
pictures = {"stream: 10, from the frame before": [picture for _, picture in live.stream(frames)]}
for iterations in (100, 10):
    single = mwdn.Reconstructor("admm", calibration, device="cpu", iterations=iterations)
    pictures[f"{iterations}, each by itself"] = [single(calibration.correct(frame)) for frame in frames]

scores = {
    name: [mwdn.psnr((x / exposure).clamp(0, 1), scene).item() for x, scene in zip(shown, scenes, strict=True)]
    for name, shown in pictures.items()
}
for name, values in scores.items():
    print(f"{name}: " + " ".join(f"{value:.1f}" for value in values) + " dB")

# %%
# A camera does not wait. `latest` reads it in a thread and hands over its newest frame only; what comes meanwhile is
# dropped, so the picture is never late.

with contextlib.closing(latest(frames)) as newest:
    seen = [measurement for measurement, _ in live.stream(newest)]
print(f"{len(seen)} of {FRAMES} frames shown, the last one among them: {torch.equal(seen[-1], captures[-1])}")

# %%
# A still scene becomes as good as with all iterations. One that moves by a pixel a frame is blurred and loses some dB.
# After the cut, the cup fades away over the next frames. A network (`universal-small`) has no memory: each of its
# frames stands alone.

figure, axes = plt.subplot_mosaic(
    [["curve"] * 4, [0, 1, 2, 3]], figsize=(7.5, 4.4), height_ratios=(1.2, 1), layout="constrained"
)
for name, values in scores.items():
    axes["curve"].plot(range(1, FRAMES + 1), values, "o-", label=name)
axes["curve"].set(xlabel="frame", ylabel="PSNR / dB", xticks=range(1, FRAMES + 1))
axes["curve"].grid(alpha=0.3)
axes["curve"].legend(fontsize=8)
for place, number in enumerate((part - 1, 2 * part - 1, 2 * part, FRAMES - 1)):
    picture = (pictures["stream: 10, from the frame before"][number] / exposure).clamp(0, 1)
    axes[place].imshow(srgb_encode(picture)[0].movedim(0, -1).numpy())
    axes[place].set_title(f"frame {number + 1}", fontsize=9)
    axes[place].axis("off")
