"""ImplicitVol (Yeung et al., arXiv 2109.12108): a volume in the weights of a network, with or without refined poses."""
