"""What a fitted model leaves of the camera's error, by its form and by chance."""
