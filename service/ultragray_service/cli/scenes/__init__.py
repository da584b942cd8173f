"""Commands on scene files: rendering, looking, exchange with other programs."""
