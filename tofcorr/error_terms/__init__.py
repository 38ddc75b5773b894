"""The predicted error of a pixel, E = constant + D + P + I, in metres.

Sign: error = measured - true; positive means that the camera reads too far, and
corrected = measured - error. Every term is linear in its coefficients: a signal term is a
combination of functions of what a frame brings (distance, amplitude), a pixel term one of
functions of where the pixel is. That split is what lets a calibration be computed from one pass
over the pixels. Variables are centred and scaled inside each term, and the single constant
belongs to the model: c0 + p0 + i0 of the paper cannot be told apart.

Terms are plain tensor mathematics, so that they script.
"""
