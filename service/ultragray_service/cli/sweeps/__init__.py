"""Commands on tracked sweeps: checking, drawing, converting."""
