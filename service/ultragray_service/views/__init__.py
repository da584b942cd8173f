"""Pictures and figures that the console looks at, made in the background."""
