"""Where things are: poses, probes and their scan lines, registrations, scan conversion. The first storey; it imports
what lies beneath alone, and no torch.
"""
