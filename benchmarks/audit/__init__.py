"""The table of cases that an audit once measured, made anew by physics that tofcorr lacks."""
