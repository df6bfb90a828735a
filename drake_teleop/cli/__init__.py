"""Command line `drake-teleop`: commands, options and printed tables."""

import gc
import sys

from drake_teleop.common.interruption import install_interrupt_handlers


def start() -> None:
    """Install signal handlers, import and run the command line; exit with 130 if interrupted."""
    install_interrupt_handlers()  # first: imports of C code can lose a KeyboardInterrupt
    gc.set_threshold(20_000)  # with 700, collections take a tenth of the compile time
    try:
        from drake_teleop.cli.main import main
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    main()
