"""The common base of all networks: a function of measurement and PSF, in two steps."""

from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import check_fit
from mwdn.optics.psf import checked_psf
from mwdn.types import Measurement, Psf, Scene, Size, size_of

Prepared = TypeVar("Prepared")
"""What a network computes from the PSF alone: tensors, or tuples and lists of tensors."""


class Network(nn.Module, Generic[Prepared]):
    """Reconstruct a scene from a measurement and a PSF: ``scene = network(measurement, psf)``.

    The PSF is an input, so one network can serve many cameras. `prepare` computes everything that depends on the PSF
    only, once per camera; `reconstruct` computes the rest for each measurement.

    Attributes:
        channels: colours of the measurement; 0 for any number.
        align: whether `mwdn.Reconstructor` aligns the PSF to each capture by default, because the network was trained
            with accurate PSFs. The network itself never aligns.
        stored_psf: whether the network takes the PSF as its file stores it, in [0, 1], with the brightness of each
            colour and the background, as the MWDN authors' code does (`mwdn.inference.methods.psf_for`). Others take
            each channel as of unit sum.

    Arguments of every subclass are checked against their annotations (`mwdn.arguments.checked`).
    """

    channels: int = 0
    align: bool = False
    stored_psf: bool = False

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            checked(cls)

    def prepare(self, psf: Psf, size: Size) -> Prepared:
        """Compute what depends on the PSF alone.

        Args:
            psf: (1 or B, 1 or C, H, W), centred; of any scale, as for `forward`, which also checks its numbers.
            size: height and width of the measurements.

        Raises:
            ShapeError: the PSF does not fit the size or the network.
        """
        raise NotImplementedError

    def reconstruct(self, measurement: Measurement, prepared: Prepared) -> Scene:
        """Reconstruct a batch.

        Args:
            measurement: (B, C, H, W).
            prepared: result of `prepare` for measurements of this size.

        Returns:
            (B, C, H, W).

        Raises:
            ShapeError: the measurement does not have the network's number of channels.
        """
        raise NotImplementedError

    def as_recorded(self, scene: Scene) -> Scene:
        """Convert a result of `reconstruct` to the geometry and light of the camera that recorded the training scenes.

        Unchanged unless these were measured before the training. `mwdn.Reconstructor` applies this.
        """
        return scene

    def as_reconstructed(self, scene: Scene) -> Scene:
        """Inverse of `as_recorded`, for a recorded scene."""
        return scene

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, C, H, W): `prepare`, then `reconstruct`.

        Args:
            measurement: (B, C, H, W), linear light, 1 is saturation; converted to the precision of the weights.
            psf: (1 or B, 1 or C, H, W), centred. Its scale does not matter: each channel counts as of unit sum,
                unless the network has ``stored_psf``.

        Raises:
            ShapeError: batch, channels or size do not fit, or one is empty.
            ParameterError: not tensors of floats, or weights of a precision that the network cannot compute in.
            PsfError: the PSF is negative, not finite, or dark; not checked in training.
        """
        check_fit(measurement, psf, "measurement")
        psf = checked_psf(psf, values=not self.training, scale=not self.stored_psf)
        weights = next(self.parameters(), psf)
        measurement, psf = measurement.to(weights.dtype), psf.to(torch.promote_types(weights.dtype, torch.float32))
        try:
            return self.reconstruct(measurement, self.prepare(psf, size_of(measurement)))
        except RuntimeError as error:  # Fourier transforms give float32, which layers of other weights refuse
            if weights.dtype == torch.float32 or isinstance(error, torch.OutOfMemoryError):
                raise
            raise ParameterError(
                f"The weights of {type(self).__name__} ({weights.dtype}) must be float32: `network.float()`. For half "
                "precision: `with torch.autocast(device.type, torch.bfloat16)`."
            ) from error


class FixedFront(Network[Prepared]):
    """A network that learns nothing before its `estimates`, so that they can be computed once for each sample.

    Its forward pass is ``correct(estimates, unit(estimates))``.
    """

    def estimates(self, measurement: Measurement, psf: Psf) -> Tensor:
        """Inputs (B, channels, H, W) of the learned part."""
        raise NotImplementedError

    def unit(self, estimates: Tensor) -> Tensor:
        """Scale (B, 1, 1, 1) of the estimates."""
        raise NotImplementedError

    def correct(self, estimates: Tensor, unit: Tensor) -> Scene:
        """Scene (B, C, H, W) from the estimates or a crop of them: the learned part."""
        raise NotImplementedError


class OtherNetwork(Network[Tensor]):
    """A module of another package, called as ``module(measurement, psf)``; its preparation is the PSF itself."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """The PSF."""
        return psf

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Result of the module."""
        return self.module(measurement, prepared)


def as_network(module: nn.Module) -> Network[Any]:
    """The module, as a `Network`."""
    return module if isinstance(module, Network) else OtherNetwork(module)
