"""One pass over the pixels: base fit, effects, and their sums pose by pose."""
