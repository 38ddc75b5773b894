"""The predicted error of a pixel, E = constant + D + P + I, in metres.

Sign: error = measured - true; positive means that the camera reads too far, and
corrected = measured - error. Every term is linear in its coefficients: a signal term is a
combination of functions of the measurement (distance, amplitude), a pixel term one of functions of
the pixel's position, a condition term one of functions of the frame's conditions. Because of this
split one pass over the pixels is enough for a calibration. Each term centres and scales its
variables. The model has a single constant: of c0, p0 and i0 of the paper only the sum is
identifiable.

`registry` lists every kind of term. A term states its inputs, its family and its form at runtime
itself (`term_options`, `base`), so that no other module lists kinds. All that a term's output
depends on is in its `state_dict`. Terms compile with TorchScript.
"""
