"""The client for ordinary programs."""
