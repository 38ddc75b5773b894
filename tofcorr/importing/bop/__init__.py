"""Scenes in BOP's layout, and BlenderProc's HDF5 files: depth images with the camera's own poses."""
