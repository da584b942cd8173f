"""TLS of both front doors: certificate files, checked before they are used and followed when they change."""
