"""What was measured: recordings on disk, read, checked, written and streamed.

A recording is a folder of NumPy arrays, one CSV and one YAML (its format, version 1, is described
in the documentation). `recording.Recording.open` checks it and maps its arrays into memory,
`frames.iterate_frames` hands out batches of bounded size in the form that fitting needs, and
`writing.RecordingWriter` writes a recording frame by frame, whole or not at all.
"""
