"""Project directories: contents, checkpoints, locking, and whether outputs are up to date."""
