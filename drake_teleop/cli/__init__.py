"""Command line `drake-teleop`: commands, options and printed tables."""

import sys

from drake_teleop.common.interruption import install_interrupt_handlers


def start() -> None:
    """Run the command line; handle signals first, because imports can lose a KeyboardInterrupt."""
    install_interrupt_handlers()
    try:
        from drake_teleop.cli.main import main
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    main()
