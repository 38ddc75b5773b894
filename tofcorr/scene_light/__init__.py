"""What the scene does to the light of a pixel, found in one frame and removed at run time."""
