"""A project's directory: what it holds, its checkpoints, who works there, and whether it is up to date."""
