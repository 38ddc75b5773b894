"""What people would try first: four ways of finding a cause in the residuals.

All start from the residuals of the same base fit and get the same covariates; a covariate speaks
for the effects listed in `covariates.SPEAKS_FOR`, and the baseline is right if the true effect is
among them.
"""
