"""UltraGauss (arXiv 2505.05643): weighted Gaussians whose intensities are averaged, without and with its shadow."""
