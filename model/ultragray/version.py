"""The version of the library, which every frame and report names."""

__version__ = "0.1.0"
