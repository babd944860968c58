"""`mwdn doctor`: the environment, for bug reports."""

from mwdn.cli.camera import console


def doctor() -> None:
    """Print versions, devices, supported precisions and threads."""
    from mwdn.runtime.environment import print_environment

    print_environment(console)
