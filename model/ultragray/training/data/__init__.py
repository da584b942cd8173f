"""What training takes from a dataset: its geometry, the first Gaussians, batches."""
