"""Scenes in BOP's layout, and BlenderProc's HDF5 files: depth with the camera's own poses."""
