"""A simulator of light and sensor: an oracle that knows no error polynomials.

A camera on a robot tool looks at a flat wall. Light leaves the camera, falls off with the square
of the distance, returns by the reflectivity of the wall, and reaches the pixels as four
correlation samples of a signal that is not quite sinusoidal. Demodulated by the equations every
such camera uses, the samples give a distance whose error nobody wrote down: it follows from
harmonics, latencies, vignetting and noise.

`simulator.simulate` draws a whole recording from options; `twin` repeats a recording that exists,
at its own poses and targets. Effects beyond the plain sensor hook into the stages of `hooks`.
"""
