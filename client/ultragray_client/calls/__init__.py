"""Calls as asyncio and threads both make them: messages, attempts, errors; no input or output."""
