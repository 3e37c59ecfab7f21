"""Optics: spline surfaces, refraction, sequential ray tracing, image reconstruction, wave propagation.  Independent of files and of
the command line."""
