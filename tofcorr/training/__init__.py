"""One training: fit, uncertainty, coverage, next poses, report, figures, and the run folder."""
