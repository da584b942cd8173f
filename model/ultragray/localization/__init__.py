"""Where in a scene a real frame was taken: its pose, found from the image."""
