"""Studies beside the product: rival methods, their comparison, reports with ablations, an environment for
reinforcement learning.
"""
