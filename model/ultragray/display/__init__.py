"""Settings of a scanner's display, and frames as they look with them. Free of torch but for `frames`."""

from ultragray.display.settings import AS_RENDERED, FRAME_RANGE_DB, Display, true_to_scale

__all__ = ["AS_RENDERED", "FRAME_RANGE_DB", "Display", "true_to_scale"]
