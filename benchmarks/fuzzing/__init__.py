"""Mutated inputs of every format, and what may come of them."""
