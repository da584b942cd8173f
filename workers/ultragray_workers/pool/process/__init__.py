"""One process of the render pool."""
