"""What a sonographer sets on a scanner, and how frames look with it. Free of torch but for `frames`."""

from .settings import AS_RENDERED, FRAME_RANGE_DB, Display, true_to_scale

__all__ = ["AS_RENDERED", "FRAME_RANGE_DB", "Display", "true_to_scale"]
