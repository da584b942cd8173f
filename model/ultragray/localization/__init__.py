"""Where in a scene a real frame was taken: its pose, found from the image."""

from .search import Localization, localize

__all__ = ["Localization", "localize"]
