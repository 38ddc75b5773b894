"""Recordings from images of other programs.

`registry` lists the importers. Each prepares its views; `run` writes the recording and its report
for all of them. Images of a moving robot go through `posed`, those of a board through
`checkerboard`.
"""
