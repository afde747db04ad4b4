"""What a person sees of a policy: videos, windows and what they show.

In: a policy, an embedded scene and its drawing. Out: pictures, files. Knows nothing of training.
"""
