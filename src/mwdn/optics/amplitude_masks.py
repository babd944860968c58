"""Masks that block light: zone aperture, coded aperture, pinholes."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.optics.masks import Mask, sample_counts
from mwdn.optics.propagation import UM_PER_MM, check_positive, coordinates
from mwdn.optics.setup import Setup
from mwdn.types import Plane, Size

Pattern = Literal["mls", "mura"]

_TAPS = {
    2: (2, 1),
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
}
"""Taps of maximum-length shift registers, exponents of primitive polynomials; period ``2^n - 1``."""


@checked
@dataclass(frozen=True)
class ZoneAperture:
    """Rings of equal area, every other one open: its shadow is a Fresnel zone pattern.

    Args:
        size_mm: height and width of the mask.
        pitch_um: sample spacing of the mask.
        zone_um: radius of the first zone: the phase of the pattern is ``pi r^2 / zone^2``, which is pi there. The
            rings are ``zone^2 / (2 r)`` wide; the finest, at the corners, set the resolution.

    References:
        T. Shimano et al., Lensless light-field imaging with Fresnel zone aperture, Appl. Opt. 57, 2841 (2018).
    """

    size_mm: tuple[float, float] = (3.2, 3.2)
    pitch_um: float = 2.0
    zone_um: float = 400.0

    def build(self, setup: Setup) -> Mask:
        """Compute the mask; it is the same for every camera.

        Raises:
            ParameterError: a number is not positive, or the finest ring is narrower than two samples.
        """
        size = sample_counts(self.size_mm, self.pitch_um)
        check_positive(zone_um=self.zone_um)
        y, x = coordinates(size[0], self.pitch_um)[:, None], coordinates(size[1], self.pitch_um)
        finest = self.zone_um**2 / (2 * math.hypot(*self.size_mm) / 2 * UM_PER_MM)
        if finest < 2 * self.pitch_um:
            needed = math.sqrt(2 * self.pitch_um * math.hypot(*self.size_mm) * UM_PER_MM)
            raise ParameterError(
                f"`pitch_um` ({self.pitch_um:g}) cannot sample rings of {finest:.3g} um at the corners: use at most "
                f"{finest / 2:.3g} um, or a `zone_um` of at least {needed:.4g}."
            )
        return Mask("amplitude", (torch.cos(torch.pi * (y**2 + x**2) / self.zone_um**2) > 0).float(), self.pitch_um)


@checked
@dataclass(frozen=True)
class CodedAperture:
    """A pattern of open and opaque squares whose spectrum has no zeros.

    Args:
        pattern: ``mls``, the separable product of two maximum-length sequences, or ``mura``, a modified uniformly
            redundant array.
        order: for ``mls``, of the sequence: ``2^order - 1`` squares a side (2 to 11). For ``mura``, the number of
            squares a side, a prime.
        feature_um: side of a square.
        pitch_um: sample spacing of the mask.

    References:
        M. S. Asif et al., FlatCam, IEEE Trans. Comput. Imaging 3, 384 (2017), for ``mls``. S. R. Gottesman, E. E.
        Fenimore, New family of binary arrays for coded aperture imaging, Appl. Opt. 28, 4344 (1989), for ``mura``.
    """

    pattern: Pattern = "mls"
    order: int = 7
    feature_um: float = 20.0
    pitch_um: float = 2.0

    def build(self, setup: Setup) -> Mask:
        """Compute the mask; it is the same for every camera.

        Raises:
            ParameterError: unknown pattern or order, or squares narrower than two samples.
        """
        check_positive(feature_um=self.feature_um, pitch_um=self.pitch_um)
        if self.feature_um < 2 * self.pitch_um:
            raise ParameterError(
                f"`pitch_um` ({self.pitch_um:g}) cannot sample squares of {self.feature_um:g} um: use at most "
                f"{self.feature_um / 2:g} um."
            )
        if self.pattern not in ("mls", "mura"):
            raise ParameterError(f"`pattern` ({self.pattern}) must be mls or mura.")
        code = separable_mls(self.order) if self.pattern == "mls" else mura(self.order)
        side = len(code) * self.feature_um / UM_PER_MM
        size = sample_counts((side, side), self.pitch_um)
        square = ((torch.arange(size[0]) + 0.5) * (self.pitch_um / self.feature_um)).long().clamp(max=len(code) - 1)
        return Mask("amplitude", code[square][:, square], self.pitch_um)


@checked
@dataclass(frozen=True)
class Pinholes:
    """Round holes at random places: each casts a dim picture of the scene, and the pictures overlap.

    Args:
        size_mm: height and width of the area with holes.
        pitch_um: sample spacing of the mask.
        count: number of holes.
        diameter_um: diameter of a hole. Below about ``2 sqrt(wavelength distance)`` diffraction widens the spot again.
        seed: seed of the places.
    """

    size_mm: tuple[float, float] = (2.4, 2.4)
    pitch_um: float = 2.0
    count: int = 25
    diameter_um: float = 50.0
    seed: int = 0

    def build(self, setup: Setup) -> Mask:
        """Compute the mask; it is the same for every camera.

        Raises:
            ParameterError: a number is not positive, the holes are narrower than two samples or wider than the mask, or
                there is no room.
        """
        size = sample_counts(self.size_mm, self.pitch_um)
        check_positive(count=self.count)
        side_um = min(self.size_mm) * UM_PER_MM
        if not 2 * self.pitch_um <= self.diameter_um <= side_um:
            raise ParameterError(
                f"`diameter_um` ({self.diameter_um:g}) must be at least 2 samples, {2 * self.pitch_um:g} um, and at "
                f"most the mask's smaller side, {side_um:g} um."
            )
        return Mask("amplitude", _holes(self, size), self.pitch_um)


def separable_mls(order: int) -> Plane:
    """``(1 + m m^T) / 2`` for a maximum-length sequence m of +1 and -1, (2^order - 1) squares a side.

    Raises:
        ParameterError: the order is not 2 to 11.
    """
    if order not in _TAPS:
        raise ParameterError(
            f"`order` ({order}) of an mls must be {min(_TAPS)} to {max(_TAPS)}: it has 2^order - 1 squares a side."
        )
    register, sequence = [1] * order, []
    for _ in range(2**order - 1):
        sequence.append(register[-1])
        feedback = sum(register[tap - 1] for tap in _TAPS[order]) % 2
        register = [feedback, *register[:-1]]
    signs = 2.0 * torch.tensor(sequence) - 1
    return (1 + torch.outer(signs, signs)) / 2


def mura(side: int) -> Plane:
    """Modified uniformly redundant array of a prime p, p squares a side.

    Open (1) where row and column are both quadratic residues modulo p, or neither; column 0 is open, row 0 is not.

    Raises:
        ParameterError: the side is not an odd prime.
    """
    if side < 3 or any(side % factor == 0 for factor in range(2, math.isqrt(side) + 1)):
        raise ParameterError(f"`order` ({side}) of a mura must be an odd prime: 31, 61, 101 ...")
    residue = torch.zeros(side, dtype=torch.bool)
    residue[[number**2 % side for number in range(1, side)]] = True
    code = (residue[:, None] == residue[None]).float()
    code[:, 0] = 1
    code[0, :] = 0
    return code


def _holes(design: Pinholes, size: Size) -> Tensor:
    """Open disks at random places, at least two diameters apart; rejection sampling."""
    generator = torch.Generator().manual_seed(design.seed)
    y, x = coordinates(size[0], design.pitch_um), coordinates(size[1], design.pitch_um)
    room = (torch.tensor(design.size_mm, dtype=torch.float64) * UM_PER_MM - 2 * design.diameter_um).clamp(min=0)
    # Disks of twice the diameter around the holes do not overlap, so their area limits the number of holes.
    most = int((room + 2 * design.diameter_um).prod() / (math.pi * design.diameter_um**2))
    places, found = torch.empty(min(design.count, most), 2, dtype=torch.float64), 0
    for _ in range(200 * design.count if design.count <= most else 0):
        place = (torch.rand(2, generator=generator, dtype=torch.float64) - 0.5) * room
        if ((place - places[:found]).norm(dim=1) > 2 * design.diameter_um).all():
            places[found] = place
            found += 1
        if found == design.count:
            break
    else:
        fitted = f"{found} did" if found else f"{most} at most would"
        raise ParameterError(
            f"`count` ({design.count}) holes of `diameter_um` ({design.diameter_um:g}) do not fit into `size_mm` "
            f"{design.size_mm} two diameters apart; {fitted}. Use fewer or smaller holes, or a larger mask."
        )
    open_ = torch.zeros(size)
    for place in places:
        open_[(y[:, None] - place[0]).square() + (x - place[1]).square() <= design.diameter_um**2 / 4] = 1
    return open_
