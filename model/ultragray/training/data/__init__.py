"""The data of a training: the geometry of its dataset, the first Gaussians, batches."""
