"""OpenIGTLink: poses come in, images go out."""
