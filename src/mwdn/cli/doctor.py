"""`mwdn doctor`: the environment, for bug reports."""

from rich.table import Table

from mwdn.cli.terminal import Json, print_json, results


def doctor(*, json: Json = False) -> None:
    """Print versions, devices, supported precisions and threads.

    Args:
        json: print them as JSON instead of a table.
    """
    from mwdn.runtime.environment import describe_environment

    facts = describe_environment()
    if json:
        print_json(facts)
        return
    table = Table(show_header=False)
    for name, value in facts.items():
        table.add_row(name, value)
    results.print(table)
