"""Jobs for all front doors: the store, those who watch a job, and its log."""
