"""python -m elastocal."""

from elastocal.cli import main

main()
