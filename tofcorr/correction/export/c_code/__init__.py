"""The templates of the corrector in C."""
