"""A simulator of light and sensor that contains no error polynomials.

A camera on a robot tool looks at a flat wall. Light leaves the camera, falls off with the square
of the distance, is reflected by the wall, and reaches the pixels as four correlation samples of a
signal that is not quite sinusoidal. The equations that every such camera uses turn the samples
into a distance. Its error is not an input: it results from harmonics, delays, vignetting and noise.

`simulator.simulate` simulates a whole recording from options. `twin` simulates the frames of an
existing recording, at its poses and targets. Effects beyond the plain sensor act at the stages of
`hooks`.
"""
