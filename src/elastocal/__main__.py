"""The `elastocal` command, and python -m elastocal."""

import sys

INTERRUPTED = 130  # 128 + SIGINT, as shells count


def main() -> None:
    """Load the command line and run it; Ctrl-C ends it with one line, whenever it comes."""
    try:
        from elastocal.screen import end_at_once, noting_interrupts

        with noting_interrupts() as noted:
            try:
                from elastocal.cli.main import main as run

                run()
            except Exception:
                # A library that is being loaded may turn an interrupt into an error of its own.
                if noted:
                    raise KeyboardInterrupt from None
                raise
            finally:
                end_at_once()
    except KeyboardInterrupt:
        sys.stderr.write("elastocal: interrupted\n")
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
