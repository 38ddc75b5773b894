"""Recordings on disk: read, checked, streamed and written.

A recording is a folder of NumPy arrays, one CSV and one YAML (docs/format.md describes the format,
version 1). `recording.Recording.open` checks it and maps its arrays into memory.
`recording.iterate_frames` yields batches of bounded size in the form that fitting needs.
`writing.RecordingWriter` writes a recording frame by frame; it appears complete or not at all.
"""
