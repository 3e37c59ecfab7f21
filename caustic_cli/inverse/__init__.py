"""The inverse problem: parametrisations, losses, optimisers and the design loop.  Independent of files and of the command line."""
