"""Import a library of an extra, or say what to install."""

from importlib import import_module
from typing import Any

from mwdn.errors import MissingPackageError, reason


def require(module: str, extra: str, *, purpose: str = "This", install: str = "") -> Any:  # noqa: ANN401
    """Import a module of an optional library.

    Args:
        module: dotted name, for example ``scipy.sparse.linalg``.
        extra: of this package, which installs it.
        purpose: what needs it, the start of the message.
        install: how to install it where an extra is not all.

    Raises:
        MissingPackageError: it is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    # ValueError: numpy and gi, for another version of a library. RuntimeError: torchvision, for another torch.
    except (ImportError, ValueError, RuntimeError) as error:
        package = (getattr(error, "name", None) or module).partition(".")[0]
        install = install or f"`pip install 'mwdn[{extra}]'`"
        raise MissingPackageError(f"{purpose} needs the package {package} ({reason(error)}): {install}.") from error
