"""A scene, its baselines and its ablations on one page."""
