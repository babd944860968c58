"""What does MWDN see at its four scales?

The Multi Wiener Deconvolution Network deconvolves the features of a U-Net, not the capture, at four scales. Here a
small one is trained for one camera, in a minute, and then opened.
"""

import matplotlib.pyplot as plt
import torch

import mwdn
from mwdn.inference.interpretation import interpret
from mwdn.inference.interpretation_page import display
from mwdn.io.pictures import dark_scene
from mwdn.optics import sample_camera, unit_sum

SIZE = 96  # pixels along each side
STEPS = 400  # of training

# %%
# One camera, and an MWDN of a tenth of the paper's width.

torch.manual_seed(0)
psf = unit_sum(sample_camera(3, (SIZE, SIZE), family="contours"))
network = mwdn.build("mwdn", width=6)
print(f"{sum(p.numel() for p in network.parameters()):,} learned numbers")

# %%
# Training: two of the bundled photographs, at random sizes and places, some mirrored, captured by this camera. The
# third photograph is for the test. The filters' w and lambda are few, so they learn ten times as fast.

filters = list(network.filters.parameters())
others = [p for name, p in network.named_parameters() if not name.startswith("filters")]
optimiser = torch.optim.Adam([{"params": others, "lr": 3e-3}, {"params": filters, "lr": 3e-2}])
decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
camera, sensor, random = mwdn.Camera(psf), mwdn.Sensor(), torch.Generator().manual_seed(0)
exposure = 0.9 / camera(torch.ones(1, 3, SIZE, SIZE)).max()  # a white scene almost saturates the sensor


def photographs():
    """Two scenes."""
    side = int(torch.randint(SIZE // 3, SIZE, (), generator=random))
    scenes = torch.cat([dark_scene(name, (SIZE, SIZE), side) for name in ("astronaut", "cat")])
    y, x = torch.randint(-SIZE // 8, SIZE // 8, (2,), generator=random).tolist()
    return scenes.roll((y, x), (-2, -1)).flip(-1 if torch.rand((), generator=random) < 0.5 else ())


errors = []
for _ in range(STEPS):
    scenes = photographs()
    captures = sensor.expose(exposure * camera(scenes), generator=random)
    error = (network(captures, psf) - scenes).square().mean()
    optimiser.zero_grad()
    error.backward()
    optimiser.step()
    decay.step()
    errors.append(error.item())
tenth = max(1, STEPS // 10)
print(f"mean squared error: {sum(errors[:tenth]) / tenth:.4f} at first, {sum(errors[-tenth:]) / tenth:.4f} at last")

# %%
# The test: a photograph that it has not seen, and what each scale does with it. `share` is how much of the picture's
# contrast goes through the filter of a scale; shares overlap.

scene = dark_scene("coffee", (SIZE, SIZE), 5 * SIZE // 8)
capture = sensor.expose(exposure * camera(scene), generator=random)
whole, *scales = interpret(network, capture, psf).rows
for row in scales:
    print(f"{row.name}: lambda {row.numbers['lambda']:.4f}, share {row.numbers['share_of_picture']:.0%}")

# %%
# A row for each scale: the PSF that its filter divides by, the feature channel with the most contrast, the same behind
# the filter, and the picture that this scale and the coarser ones make. The rim of the cup comes from the finest scale.
# From scale to scale the PSF loses its lines, until nothing is left to divide by. The picture, top right, is poor: a
# training for real takes hours and thousands of photographs.

columns = "PSF used", "features", "deconvolved", "from here down"
figure, axes = plt.subplots(len(scales), len(columns), figsize=(7.5, 7.8), layout="constrained")
for line, row in zip(axes, scales, strict=True):
    for axis, title in zip(line, columns, strict=True):
        panel = next(panel for panel in row.panels if panel.name.startswith(title))
        axis.imshow(display(panel)[0].movedim(0, -1).numpy())
        axis.set_title(f"{row.name}: {title}" if title == "PSF used" else title, fontsize=9)
        axis.axis("off")
