"""Methods by their names: solvers, bundled networks and checkpoints."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mwdn import solvers
from mwdn.calibration import Calibration
from mwdn.calibration.psf_identity import other_psf
from mwdn.errors import CheckpointError, ParameterError, UnknownNameError
from mwdn.networks import DENOISERS, NETWORKS, Network
from mwdn.types import Measurement, Psf, Scene
from mwdn.weights.bundled import BUNDLED, find_weights, stored_metadata
from mwdn.weights.checkpoint import WEIGHT_SUFFIXES, load_checkpoint

Method = Callable[[Measurement, Psf], Scene]
"""A solver or a network, called as ``method(measurement, psf)``."""


def find_method(name: str | Path, **options: Any) -> Method:  # noqa: ANN401
    """Find a solver or a bundled network by its name, or a network by the path of its checkpoint.

    Args:
        name: the name or the path; ``hub:owner/name`` for a network on the Hugging Face hub.
        **options: of a solver, for example ``regularisation=1e-4``. A network's options are in its checkpoint.

    Raises:
        UnknownNameError: neither a solver nor a file, or the solver has no such option.
        CheckpointError: the file holds no usable weights.
        ParameterError: an option is out of range, a network is given options, or a network needs training first.
    """
    if str(name) in solvers.SOLVERS:
        return solvers.build(str(name), **options)
    if options:
        names = ", ".join(f"`{option}`" for option in options)
        raise ParameterError(
            f"{names} cannot be set for '{name}': only solvers ({', '.join(solvers.SOLVERS)}) have options. "
            "See `mwdn methods`."
        )
    path = find_weights(str(name)) or Path(name)
    if path.suffix in WEIGHT_SUFFIXES or path.is_file():
        network = load_checkpoint(path)
        if isinstance(network, tuple(DENOISERS.values())):
            raise CheckpointError(
                f"`{name}` holds a denoiser, which cannot reconstruct on its own. Use it as `denoiser` in [schedule] "
                "of a recipe such as `mwdn recipes universal-plug`."
            )
        return network
    if str(name) in NETWORKS:
        raise ParameterError(
            f'`{name}` is a network without weights. Train it with `name = "{name}"` in [network] of the recipe: '
            f"`mwdn train RECIPE.toml --psf psf.png --photos photos/ --out runs/{name}`. The method is then "
            f"`runs/{name}/best.safetensors`. `universal` needs no training."
        )
    raise UnknownNameError("method", str(name), [*BUNDLED, *solvers.SOLVERS, "PATH/OF/CHECKPOINT.safetensors"])


def as_method(method: Method | str | Path, **options: Any) -> Method:  # noqa: ANN401
    """A method as it is, or `find_method` with options.

    Raises:
        ParameterError: options are given for an object, a class is given, or as for `find_method`.
        MwdnError: as for `find_method`.
    """
    if isinstance(method, str | Path):
        return find_method(method, **options)
    if isinstance(method, type):
        raise ParameterError(f"The method (the class `{method.__name__}`) must be an object: `{method.__name__}()`.")
    if options:
        raise ParameterError(f"Options ({', '.join(options)}) need a method given by its name, not an object.")
    return method


def method_name(method: Method | str | Path) -> str:
    """The name or path of a method as given, or the name of an object's type."""
    return str(method) if isinstance(method, str | Path) else type(method).__name__


def psf_for(method: object, calibration: Calibration) -> Psf:
    """The PSF that a method takes, (1, C, H, W).

    Most take the calibration's, whose channels have unit sum. A network with ``stored_psf`` takes that of the file: the
    numbers in [0, 1] with the brightness of each colour, and the background if none was subtracted. A calibration
    without the brightness (``light``) gives a peak of 1.
    """
    psf = calibration.psf
    if not (isinstance(method, Network) and method.stored_psf):
        return psf
    if not calibration.light:
        return psf / psf.max()
    return psf * psf.new_tensor(calibration.light)[:, None, None]


def background_warning(name: str, method: object, calibration: Calibration) -> str | None:
    """Warning if a network takes the PSF as stored, with its background, but the calibration subtracted that."""
    takes_all = isinstance(method, Network) and method.stored_psf
    if not takes_all or not any(calibration.background):
        return None
    return (
        f"`{name}` takes the PSF as stored, with its background, which was subtracted: calibrate with `background=0`."
    )


def psf_warning(method: str | Path, calibration: Calibration) -> str | None:
    """Warning if the network was trained for another PSF than the calibration's."""
    metadata = stored_metadata(method)
    trained = other_psf(calibration, metadata) if metadata else None
    return trained and (
        f"`{method}` was trained for PSF {trained}, but the calibration has PSF {calibration.psf_hash}. "
        "Expect blur, ghosts and invented detail, unless both are from the same camera: another crop, bin or "
        "background counts as another PSF. Use the PSF of the training, or train for this one: `mwdn train`."
    )
