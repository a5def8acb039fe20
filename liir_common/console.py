"""The `liir` command, wherever the package is installed without what the command needs, too."""

import sys


def main() -> None:
    """Run it, or say what to install."""
    try:
        from liir_common import cli
    except ModuleNotFoundError as error:
        sys.exit(
            f"error: the liir command needs {error.name}; install 'liir-service[client]' for what fetches "
            "checkpoints and plays them, 'liir-service[service]' for all that trains"
        )
    cli.main()
