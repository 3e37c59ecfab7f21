"""One file per subcommand: parse, call, present.  Nothing here knows physics; torch is imported inside the bodies."""
