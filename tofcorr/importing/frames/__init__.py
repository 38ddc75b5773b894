"""Folders of depth images beside a file of robot poses."""
