"""Methods side by side: each fitted within the same budget, measured on the same frames, shown on one page."""
