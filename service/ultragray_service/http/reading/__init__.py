"""Requests as HTTP brings them: accepted types, JSON bodies, uploads in parts."""
