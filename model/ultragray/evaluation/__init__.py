"""How good a scene is: metrics on held-out frames, beside classical baselines."""
