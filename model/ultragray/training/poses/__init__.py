"""Pose refinement: the tracker's errors are estimated from the path of the probe and from the images, and removed."""
