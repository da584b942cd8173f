"""Foreign formats: the released checkpoints, PLY, and the files that frames are exported to."""
