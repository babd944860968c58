"""Reconstruction networks, one file per method. Each is called as ``network(measurement, psf)``."""

from typing import Any

from torch import nn

from mwdn.arguments import check_at_least, check_options
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.networks.drunet import Drunet
from mwdn.networks.flatnet import FlatNet
from mwdn.networks.ifin import Ifin
from mwdn.networks.le_admm import LeAdmm
from mwdn.networks.le_admm_u import LeAdmmU
from mwdn.networks.mmcn import Mmcn
from mwdn.networks.mwdn import Mwdn
from mwdn.networks.mwdn_cpsf import MwdnCpsf
from mwdn.networks.network import Network
from mwdn.networks.svdeconv import SvDeconv
from mwdn.networks.unet import UNet
from mwdn.networks.updn import Updn
from mwdn.networks.wiener import WienerNetwork
from mwdn.networks.wiener_bank import WienerBank
from mwdn.networks.wiener_unet import WienerUNet
from mwdn.runtime.plugins import Registry, check_complete, plugin_errors
from mwdn.solvers import BUNDLED_NAMES, SOLVERS

_OWN: dict[str, type[Network[Any]]] = {
    "wiener": WienerNetwork,
    "unet": UNet,
    "wiener-unet": WienerUNet,
    "mwdn": Mwdn,
    "mwdn-cpsf": MwdnCpsf,
    "wiener-bank": WienerBank,
    "le-admm": LeAdmm,
    "le-admm-u": LeAdmmU,
    "mmcn": Mmcn,
    "updn": Updn,
    "flatnet": FlatNet,
    "svdeconv": SvDeconv,
    "ifin": Ifin,
}

NETWORKS: Registry[type[Network[Any]]] = Registry(
    _OWN,
    "mwdn.networks",
    accepts=lambda entry: isinstance(entry, type) and issubclass(entry, Network),
    must_be="a subclass of `mwdn.networks.Network`",
    reserved=frozenset(SOLVERS.own) | BUNDLED_NAMES,
)
"""Networks by the names used in recipes and on the command line, those of plugins included."""

DENOISERS: dict[str, type[nn.Module]] = {"drunet": Drunet}
"""Denoisers, trained on their own as parts of networks: ``clean = denoiser(picture, level)``."""


def build(name: str, **options: Any) -> nn.Module:  # noqa: ANN401
    """Build an untrained network.

    Args:
        name: one of `NETWORKS` or `DENOISERS`.
        **options: keyword arguments of the network, for example ``width=32``.

    Raises:
        UnknownNameError: no such network, or it has no such option.
        PluginError: the class is a plugin's and raises an error.
        ParameterError: ``name`` is a solver, ``width`` or ``channels`` is below 1, or an option is of another type.
    """
    kind = DENOISERS.get(name) or NETWORKS.get(name)
    if kind is None and name in SOLVERS:
        raise ParameterError(f"'{name}' is a solver, not a network: `mwdn.solvers.build('{name}')`.")
    if kind is None:
        raise UnknownNameError("network", name, NETWORKS)
    check_options(kind, f"the network '{name}'", options)
    check_complete(kind, f"the network '{name}'", options)
    check_at_least(1, width=options.get("width", 1), channels=options.get("channels", 1))
    # JSON and TOML have lists, not tuples.
    with plugin_errors(name, kind):
        network = kind(**{key: tuple(v) if isinstance(v, list) else v for key, v in options.items()})
    return network.float()  # also where `torch.set_default_dtype` says otherwise


__all__ = [
    "DENOISERS",
    "NETWORKS",
    "Drunet",
    "FlatNet",
    "Ifin",
    "LeAdmm",
    "LeAdmmU",
    "Mmcn",
    "Mwdn",
    "MwdnCpsf",
    "Network",
    "SvDeconv",
    "UNet",
    "Updn",
    "WienerBank",
    "WienerNetwork",
    "WienerUNet",
    "build",
]
