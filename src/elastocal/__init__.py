"""elastocal: calibrate industrial robot arms and explain what is left over."""

__version__ = "0.1.0"
