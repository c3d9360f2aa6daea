"""What a scene says: every setting, presets, and the YAML file."""
