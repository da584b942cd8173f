"""The comparison of methods on one sweep: the same frames, budget and metrics code for all, one table and one page."""
