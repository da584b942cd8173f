"""Parts that several learned methods share."""
