"""Learning: a sweep becomes a scene (training), is measured on frames it never saw (evaluation), and finds where a
frame was taken (localization).
"""
