"""Levels and coverage of the diagnosis on hundreds of small recordings, in one process."""
