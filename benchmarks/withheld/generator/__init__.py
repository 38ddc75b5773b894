"""A second, independent simulator: NumPy only, nothing of `tofcorr`.

A scene is drawn (`scene`), observed without noise (`observe`) with or without `Effect`s, each of
which changes one stage of the signal chain: poses, rays, plane, relief, path, light or taps.
`noise` makes the recording of it.
"""
