"""One step: losses, the optimizer and its rates, Gaussians added and pruned."""
