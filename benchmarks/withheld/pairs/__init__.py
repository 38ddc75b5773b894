"""The check of `tofcorr diagnose --sim RECORDING`: a camera and a simulator of it, as recordings.

`cases` writes pairs and, apart, sealed answers; `commands` runs the program on the recordings and
scores what it says; `renderer` lets PyBullet draw the simulator's frames.
"""
