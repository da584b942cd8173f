"""Where probes see, and how robots lie to scenes."""
