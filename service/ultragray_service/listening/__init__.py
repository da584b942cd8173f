"""Sockets that listen: who may connect, how many, and how long each may take."""
