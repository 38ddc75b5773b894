"""Recordings made from what other programs recorded: one source a folder, one report for all."""
