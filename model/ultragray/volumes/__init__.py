"""A scene without a probe: its fields on grids of points, as volumes for other programs and as slices.

The package itself imports nothing, so that `names` stays free of torch.
"""
