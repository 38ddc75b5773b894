"""A camera as it was found, and what it would measure of any scene.

`sensor_file` is the file `sensor.yaml`: error terms, effects, noise and missing pixels.
`model.SensorModel` turns ideal depth into what that camera measures; `degrade` does so for a whole
recording.
"""
