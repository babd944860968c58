"""Import a library that only one bridge needs."""

from importlib import import_module
from types import ModuleType

from mwdn.errors import MissingPackageError, reason


def require(module: str, extra: str) -> ModuleType:
    """Import a module of an optional library.

    Args:
        module: dotted name, for example ``scipy.sparse.linalg``.
        extra: of this package, which installs it.

    Raises:
        MissingPackageError: it is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingPackageError(
            f"This needs the package {package} ({reason(error)}): `pip install 'mwdn[{extra}]'`."
        ) from error
