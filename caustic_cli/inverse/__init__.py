"""Which lens: parametrisations, losses, optimisers and the design loop.  Knows no files and no command line."""
