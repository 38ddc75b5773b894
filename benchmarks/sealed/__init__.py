"""Checks whose answers are sealed: cases, diagnoses of recordings alone, truth, scores."""
