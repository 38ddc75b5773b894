"""The mathematics of a fit, on per-image moments; it knows no files.

The point-to-plane residual of a pixel is bilinear: linear in the rotation's entries times
(1, coefficients), and linear in the translation. So one pass over the pixels reduces each image to
a small matrix of moments that determines every squared loss. Solvers, covariance, folds and
bootstraps work on those matrices and need no pixel again.
"""
