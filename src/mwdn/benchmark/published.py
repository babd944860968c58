"""How each method's authors trained it, as far as they say: data for a comparison with each one's own settings."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """An optimiser as published. ``None`` where the source does not say.

    Args:
        optimiser: name, as in a recipe's ``[schedule]``.
        rate: learning rate at its highest.
        source: where this stands.
        weight_decay: of the optimiser.
        batch: samples a step, those of accumulated gradients together.
        epochs: passes over the training pairs, at most.
        course: of the learning rate: "constant", "cosine" or "plateau".
        loss: weights of the parts of the loss, by the names of a recipe's ``[loss]``. What a source calls perceptual is
            named by the nearest part that we have.
    """

    optimiser: str
    rate: float | None
    source: str
    weight_decay: float = 0.0
    batch: int | None = None
    epochs: int | None = None
    course: str | None = None
    loss: tuple[tuple[str, float], ...] = (("mse", 1.0),)


_MWDN = Published(
    "adam",
    1e-4,
    "the MWDN authors' code: ReduceLROnPlateau(0.1, patience 5), loss weights 1 and 1, then 1 and 0.05",
    weight_decay=1e-4,
    batch=16,
    epochs=300,
    course="plateau",
    loss=(("mse", 1.0), ("feature_mse", 1.0)),
)
_LE_ADMM = Published("adam", None, "Monakhova et al. 2019; neither paper nor code found here gives the rate")

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
        course="constant",
    ),
    "flatnet": Published(
        "adam",
        3e-4,
        "code of Khan et al. 2020 (FlatNet-gen): 4e-10 for the inverse, in its units; also an adversarial part, 0.6",
        batch=5,
        epochs=31,
        course="cosine",
        loss=(("mse", 1.0), ("feature_mse", 1.2)),
    ),
    "svdeconv": Published(
        "adam",
        1e-4,
        "code of PhoCoLens 2024 for DiffuserCam: 3e-5 for the PSFs; its perceptual part is VGG's",
        batch=5,
        epochs=100,
        course="cosine",
        loss=(("mse", 1.0), ("feature_mse", 0.05)),
    ),
}
"""By the names of `NETWORKS`. Missing: `mmcn` and `ifin`, whose settings were not found; `wiener-bank` is our own."""
