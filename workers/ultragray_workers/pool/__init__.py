"""The render pool, as the service sees it."""
