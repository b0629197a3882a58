"""The version of keyss."""

__version__ = "0.1.0"
