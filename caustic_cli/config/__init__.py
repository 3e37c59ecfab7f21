"""Configuration: the keys of project.toml, their defaults, and derived values."""
