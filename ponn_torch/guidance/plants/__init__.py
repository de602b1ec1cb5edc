"""Tracking problems, one file each; a config of the group problem names the function."""
