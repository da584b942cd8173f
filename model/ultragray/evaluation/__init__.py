"""The quality of a scene: metrics on held-out frames, beside classical baselines."""
