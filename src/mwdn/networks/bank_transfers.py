"""What `mwdn.networks.wiener_bank.WienerBank` prepares from a PSF, and its parts for some of the colours."""

from typing import NamedTuple

from torch import Tensor

from mwdn.types import Measurement


class BankTransfers(NamedTuple):
    """What `WienerBank` precomputes from a PSF.

    Args:
        levels: transfer function and norm of the PSF at each level of the iterations, coarsest first.
        filters: transfer function of each Wiener filter; empty if the finest level's is used instead.
    """

    levels: tuple[tuple[Tensor, Tensor], ...]
    filters: tuple[Tensor, ...]

    def part(self, colours: slice) -> "BankTransfers":
        """Those of some of the colours."""
        levels = tuple((part_of(transfer, colours), norm) for transfer, norm in self.levels)
        return BankTransfers(levels, tuple(part_of(transfer, colours) for transfer in self.filters))


def part_of(transfer: Tensor, colours: slice) -> Tensor:
    """A transfer function (B, C, ...) for some of the colours; a grey one is that of all."""
    return transfer[:, colours] if transfer.shape[1] > 1 else transfer


def by_colour(measurement: Measurement, transfers: BankTransfers, count: int) -> list[tuple[Tensor, BankTransfers]]:
    """Measurement and transfer functions in up to ``count`` parts with some of the colours each."""
    colours = measurement.shape[1]
    step = -(-colours // min(colours, count))
    parts = [slice(first, first + step) for first in range(0, colours, step)]
    return [(measurement[:, part], transfers.part(part)) for part in parts]
