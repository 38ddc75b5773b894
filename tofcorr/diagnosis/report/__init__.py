"""The result for people and programs: JSON, verdict, figures, page."""
