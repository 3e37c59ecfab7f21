"""The subcommands, one file each: parsing of arguments, call of the workflow, output of results.  torch is imported on demand."""
