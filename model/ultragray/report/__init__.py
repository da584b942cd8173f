"""Reports: a scene against its baselines and ablations, as numbers and as one HTML page."""
