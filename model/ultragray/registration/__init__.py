"""The frames of robots and trackers against a scene's: registered from points, poses or real frames."""
