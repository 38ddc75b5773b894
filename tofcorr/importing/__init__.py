"""Recordings from images of other programs.

`registry` lists the importers. Each prepares its views; `engine` writes the recording and the
`report` for all of them.
"""
