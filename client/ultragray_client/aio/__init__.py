"""The client for asyncio, with the same methods."""
