"""The scene: its Gaussians, its file, and what it knows of itself. The second storey."""
