"""Ultra-NeRF (Wysocki et al., MIDL 2023): a field of tissue parameters, and a renderer that follows scan lines."""
