"""What project.toml may say: its keys, their defaults, and the values that follow from others."""
