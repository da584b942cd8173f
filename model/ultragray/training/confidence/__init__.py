"""How far a trained scene can be trusted: frames held out, places that are hard, the fit."""
