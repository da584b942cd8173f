"""Which parts of the service are in order, and whether it is ready."""
