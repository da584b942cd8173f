"""The fit of a trained scene's confidence: the frames held out for it, and the places that are hard."""
