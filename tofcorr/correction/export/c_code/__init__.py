"""The corrector as C99 source: what it holds, how it is written, and how it is compiled."""
