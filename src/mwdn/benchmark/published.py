"""Training settings that each network's authors published."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """Published training settings of a network; ``None`` if the source does not say.

    Args:
        optimiser: name, as in a recipe's ``[schedule]``.
        rate: highest learning rate.
        source: where the settings come from.
        weight_decay: of the optimiser.
        batch: samples per step, including accumulated gradients.
        epochs: maximum number of passes over the training pairs.
        lr_schedule: learning rate schedule: "constant", "cosine" or "plateau".
        loss: weights of the loss's parts, by their names in a recipe's ``[loss]``. A source's perceptual loss has the
            name of the nearest part of this package.
    """

    optimiser: str
    rate: float | None
    source: str
    weight_decay: float = 0.0
    batch: int | None = None
    epochs: int | None = None
    lr_schedule: str | None = None
    loss: tuple[tuple[str, float], ...] = (("mse", 1.0),)


_MWDN = Published(
    "adam",
    1e-4,
    "the MWDN authors' code: ReduceLROnPlateau(0.1, patience 5), loss weights 1 and 1, then 1 and 0.05",
    weight_decay=1e-4,
    batch=16,
    epochs=300,
    lr_schedule="plateau",
    loss=(("mse", 1.0), ("feature_mse", 1.0)),
)
_LE_ADMM = Published("adam", None, "Monakhova et al. 2019; neither the paper nor the code gives the rate")

PUBLISHED: dict[str, Published] = {
    "wiener": _MWDN,
    "unet": _MWDN,
    "wiener-unet": _MWDN,
    "mwdn": _MWDN,
    "mwdn-cpsf": _MWDN,
    "le-admm": _LE_ADMM,
    "le-admm-u": _LE_ADMM,
    "updn": Published(
        "adam",
        5e-4,
        "code of Kingshott et al. 2022: 2 samples, gradients of 2 added",
        batch=4,
        epochs=5,
        lr_schedule="constant",
    ),
    "flatnet": Published(
        "adam",
        3e-4,
        "code of Khan et al. 2022 (FlatNet-gen): 4e-10 for the inverse, in its units; also an adversarial part, 0.6",
        batch=5,
        epochs=31,
        lr_schedule="cosine",
        loss=(("mse", 1.0), ("feature_mse", 1.2)),
    ),
    "svdeconv": Published(
        "adam",
        1e-4,
        "code of PhoCoLens 2024 for DiffuserCam: 3e-5 for the PSFs; its perceptual part is VGG's",
        batch=5,
        epochs=100,
        lr_schedule="cosine",
        loss=(("mse", 1.0), ("feature_mse", 0.05)),
    ),
}
"""By network name. `mmcn` and `ifin` are missing because no settings are published; `wiener-bank` is our own."""
