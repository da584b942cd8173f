"""MCAP files with images and poses of ROS 2, such as `ros2 bag record -s mcap` writes them. The extra `mcap`."""

from ultragray.datasets.mcap.recording import read_mcap_sweep

__all__ = ["read_mcap_sweep"]
