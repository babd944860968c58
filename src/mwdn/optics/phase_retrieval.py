"""Phase retrieval: the phase on the mask that makes a given pattern on the sensor."""

import torch

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import fast_length, filter_field
from mwdn.optics.propagation import angular_spectrum, check_positive, needed_samples
from mwdn.types import Field, Plane


def retrieve_phase(
    target: Plane,
    illumination: Field,
    *,
    pitch_um: float,
    wavelength_nm: float,
    distance_mm: float,
    iterations: int = 20,
) -> Plane:
    """Phase of a transparent mask whose light forms a target pattern on the sensor (Gerchberg and Saxton).

    The field is propagated back and forth between the two planes: with P the propagation from the mask to the sensor,
    A the amplitude of the illumination and T the intensity of the target,

        mask = A exp(i arg(P^-1 sensor)),    sensor = sqrt(T) exp(i arg(P mask)).

    The phase on the sensor starts at 0, which makes smooth lines; a random start leaves speckle.

    Args:
        target: intensity on the sensor, of any scale.
        illumination: light that falls onto the mask; as many samples as ``target``.
        pitch_um: sample spacing.
        wavelength_nm: of the light.
        distance_mm: from the mask to the sensor.
        iterations: rounds; the light on a contour mask's lines after 20 is within 1 % of that after 60.

    Returns:
        Phase delay of the mask in radians, in [0, 2 pi).

    Raises:
        ParameterError: a number is not positive, or ``target`` is dark or not of the size of ``illumination``.

    References:
        R. W. Gerchberg, W. O. Saxton, Optik 35, 237 (1972), with free space between the planes, as V. Boominathan
        et al., PhlatCam, IEEE TPAMI 42, 1618 (2020), design contour masks.
    """
    check_positive(pitch_um=pitch_um, wavelength_nm=wavelength_nm, distance_mm=distance_mm, iterations=iterations)
    if target.shape != illumination.shape or not target.max() > 0:
        raise ParameterError(
            f"`target` {tuple(target.shape)} must not be dark, and must have the size of `illumination` "
            f"{tuple(illumination.shape)}."
        )
    height, width = target.shape
    step = {"pitch_um": pitch_um, "wavelength_nm": wavelength_nm, "distance_mm": distance_mm}
    grid = fast_length(needed_samples(height, height, **step)), fast_length(needed_samples(width, width, **step))
    forth = angular_spectrum(grid, **step)
    back = forth.conj().resolve_conj()
    on_sensor, on_mask = target.clamp(min=0).sqrt(), illumination.abs()
    sensor = torch.complex(on_sensor, torch.zeros_like(on_sensor))
    for _ in range(iterations - 1):
        mask = _with_amplitude(filter_field(sensor, back)[:height, :width], on_mask)
        sensor = _with_amplitude(filter_field(mask, forth)[:height, :width], on_sensor)
    mask = filter_field(sensor, back)[:height, :width]
    return (mask * illumination.conj()).angle().remainder(2 * torch.pi)


def _with_amplitude(field: Field, amplitude: Plane) -> Field:
    return field * (amplitude / field.abs().clamp(min=1e-12))
