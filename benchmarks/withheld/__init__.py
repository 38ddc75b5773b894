"""The regression set: one plain camera, and one thing at a time that is wrong or missing."""
