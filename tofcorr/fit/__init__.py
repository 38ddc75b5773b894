"""From usable pixels to parameters: one fit of one model to some frames.

`fitting.fit` runs five steps: `prepare` reads the pixels into moments, `solve` minimises the loss,
`hold` puts a prior on directions that the images do not determine, `estimate_walls` solves again
where the walls are unknown, and `finish` adds what does not go through moments.
"""
