"""Where a frame was taken: the search for its pose in a scene."""
