"""Whose turn it is, and how long that will take: shares of the workers' time for clients, and forecasts of it."""
