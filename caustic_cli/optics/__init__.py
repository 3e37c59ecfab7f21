"""What light does: spline surfaces, refraction, tracing, image reconstruction.  Knows no files and no command line."""
