"""Plants to track with or to land, one file each; a config of the group problem names the function."""
