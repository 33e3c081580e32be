"""The `elastocal` command, and python -m elastocal."""

import sys

INTERRUPTED = 130  # 128 + SIGINT, as shells count


def main() -> None:
    """Load the command line and run it; Ctrl-C ends it with one line, also while it is loaded."""
    try:
        from elastocal.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("elastocal: interrupted\n")
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
