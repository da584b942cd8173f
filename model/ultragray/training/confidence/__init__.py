"""The fit of a trained scene's confidence and uncertainty, by a shorter training that holds frames out."""
