"""How the unknowns are found, from per-image moments.

The point-to-plane residual of a pixel is bilinear: linear in the rotation's entries times
(1, coefficients), and linear in the translation. So one pass over the pixels leaves, per image,
a small matrix of moments that holds everything a squared loss needs. Solvers, covariance, folds
and bootstraps work on those matrices and never see a pixel again.
"""
