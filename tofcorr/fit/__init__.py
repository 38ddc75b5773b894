"""From pixels to parameters: the fit of one model to some frames."""
