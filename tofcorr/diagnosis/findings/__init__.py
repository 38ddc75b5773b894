"""Conclusions from the sums: where simulator and recording differ, and which effects explain it."""
